"""How much memory a scene takes, before any of it is taken, and how much there is."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ddrecon.march.integral import CHUNK_NODES

GIVEN_BACK = 2**25
"""Arrays larger than this many bytes leave the process when they are done with; smaller ones stay
with its allocator (glibc's).
"""
SHORTAGES = (
    "not enough memory",
    "out of memory",
    "can't allocate memory",
    "alloc_cpu",
    "bad alloc",
)
"""What torch says, in one place or another, where it gets no memory."""


@dataclass(frozen=True)
class Needs:
    """What the memory of a scene depends on: `resolution` (x, y, z), `colors` (1 or 3), bytes of a
    number, pixels of all views.

    `varied` is how many fields are optimized, each color counted; None where nothing is.
    """

    resolution: tuple[int, int, int]
    colors: int
    size: int
    pixels: int
    has_flux: bool = False
    has_rounds: bool = False
    is_limited: bool = False
    varied: float | None = None

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.resolution[0] * self.resolution[1] * self.resolution[2]


def memory_of(needs: Needs) -> int:
    """Bytes that rendering all views takes at its peak, with derivatives where something is
    optimized, without torch itself.

    Fitted to what `benchmarks/memory.py` measures, in numbers per cell and in buffers of marched
    nodes. Those that are alive at a time are known well; where arrays stay with the allocator it
    holds up to twice as much, for others of the same size.
    """
    colors, size, cells = needs.colors, needs.size, needs.cells
    flux, rounds, limited = needs.has_flux, needs.has_rounds, needs.is_limited
    numbers, buffers, kept = (
        17.0 + (21 + 3 * flux + 16 * rounds + 7 * limited) * colors,
        6.0 + 2 * colors,
        1.1,
    )
    images = 3
    if needs.varied is not None:
        numbers = 50 + 15 * needs.varied + (7 + 13 * flux + 34 * rounds + 32 * limited) * colors
        buffers, kept = (
            12 * colors + 4 * needs.varied,
            1.9 if size * colors * cells <= GIVEN_BACK else 1.5,
        )
        images = 9  # targets, those of a coarser level, renders
    factor = kept if size * cells <= GIVEN_BACK else 1.1
    return int(size * ((numbers * cells + buffers * CHUNK_NODES) * factor + images * needs.pixels))


def shortage(needs: Needs, device: torch.device) -> str | None:
    """What to say of a scene with such `needs` where it does not fit into the memory that is free
    on `device`; None where it does.
    """
    needed, free = memory_of(needs), free_memory(device)
    if free is None or needed <= free:
        return None
    place = "this machine" if device.type == "cpu" else "the GPU"
    fits = [words for words, other in _smaller(needs, free) if memory_of(other) <= free]
    return f"takes about {gibibytes(needed)}, but {place} has {gibibytes(free)} free; this would fit: {', or '.join(fits) or 'nothing'}"


def _smaller(needs: Needs, free: int) -> Iterator[tuple[str, Needs]]:
    """What could be given up, in the words of the command line."""
    if needs.size == 8:
        yield "--dtype float32", replace(needs, size=4)
    if needs.has_rounds:
        yield "-D diffusion.transport_rounds=0", replace(needs, has_rounds=False)
    if needs.is_limited:
        yield "-D diffusion.model=p1", replace(needs, is_limited=False)
    part = 1.0
    while (
        memory_of(coarser := replace(needs, resolution=_scaled(needs.resolution, part))) > free
        and part > 1e-3
    ):
        part *= 0.95
    yield f"volume.resolution: [{', '.join(map(str, coarser.resolution))}]", coarser


def _scaled(resolution: tuple[int, int, int], part: float) -> tuple[int, int, int]:
    x, y, z = (max(1, int(part * cells)) for cells in resolution)
    return x, y, z


def free_memory(device: torch.device) -> int | None:
    """Bytes that this process can still take on `device`, by what the system and its limits on
    groups of processes say; None if unknown.
    """
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return int(free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device))
    known = [amount for amount in (_available(), *_group_limits()) if amount is not None]
    return min(known) if known else None


def _available() -> int | None:
    """What /proc/meminfo says is available, or all there is."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(
            1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")
        )
    except (OSError, StopIteration, ValueError):
        return (
            os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
            if hasattr(os, "sysconf")
            else None
        )


def _group_limits(
    root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")
) -> Iterator[int]:
    """What is left of the memory of each control group this process is in, of either version of
    them.
    """
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, kinds, path = line.split(":", 2)
        if not kinds:
            yield from _left(root, path, "memory.max", "memory.current", "inactive_file")
        elif "memory" in kinds.split(","):
            yield from _left(
                root / "memory",
                path,
                "memory.limit_in_bytes",
                "memory.usage_in_bytes",
                "total_inactive_file",
            )


def _left(root: Path, path: str, limit: str, usage: str, cached: str) -> Iterator[int]:
    for folder in (root / path.lstrip("/"), *(root / path.lstrip("/")).parents):
        try:
            most, used = (folder / limit).read_text().strip(), int((folder / usage).read_text())
            statistics = dict(
                line.split() for line in (folder / "memory.stat").read_text().splitlines()
            )
            if most != "max":
                yield int(most) - used + int(statistics.get(cached, 0))
        except (OSError, ValueError):
            pass
        if folder == root:
            return


def is_shortage(error: BaseException) -> bool:
    """Whether `error` is what Python or torch raise where they get no memory."""
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(
        words in str(error).lower() for words in SHORTAGES
    )


def gibibytes(amount: int) -> str:
    """`amount` bytes in words."""
    return f"{amount / 2**30:.3g} GiB" if amount >= 2**30 else f"{amount / 2**20:.0f} MiB"
