"""How much memory a scene takes, before any of it is taken; what memory and cores there are."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from ddrecon.diffusion.rounds.fused.directions import piece_numbers
from ddrecon.engine import current_engine
from ddrecon.grid import Grid
from ddrecon.kernels import spare
from ddrecon.kernels.spare import LARGEST, give_freed_memory
from ddrecon.march.integral import CHUNK_NODES

GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
"""Where Linux has its control groups, and says in which this process is."""
UNIFIED = "memory.max", "memory.current", "inactive_file"
DIVIDED = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
"""The files of a group's limit and usage, and what can be given back of that, by both versions."""
SMALL = 2**24
"""Bytes of arrays that are small beside what else the process holds."""
MATTER = 4
"""Fields of each color that view rays meet besides the masses to lights, at most as a rule."""
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
    """What the memory of a scene depends on.

    `resolution` (x, y, z), `colors` (1 or 3), `size`: bytes of a number, `pixels` of all views.
    `moments` is how many of light rounds keep. `varied` is how many fields are optimized, each
    color counted; None where nothing is. `threads` are those of fused kernels (`count_threads`).
    Light is computed in cells so many `times` as narrow `along` axes.
    """

    resolution: tuple[int, int, int]
    colors: int
    size: int
    pixels: int
    has_flux: bool = False
    has_rounds: bool = False
    moments: int = 1
    is_limited: bool = False
    varied: float | None = None
    lights: int = 1
    threads: int = 1
    times: int = 1
    along: str = "xyz"

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells along z, y and x, `times` as narrow as those of the scene."""
        grid = Grid.from_xyz(self.resolution, (0.0,) * 3, (1.0,) * 3)
        return grid.refine(self.times, self.along).shape

    @property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(self.shape)


def memory_of(needs: Needs, is_short: bool = False) -> int:
    """Bytes that rendering all views takes at its peak, without torch itself.

    With derivatives where something is optimized. `is_short`: where freed memory is given back.
    """
    alive = CHUNK_NODES * _numbers_at_node(needs) + needs.cells * _numbers_in_cell(needs)
    of_light = alive * _overhead(needs, is_short)
    # Targets, those of a coarser level, what rays meet, renders.
    in_pixel = 12 if needs.varied is None else 18
    return int(needs.size * (of_light + in_pixel * needs.pixels)) + shared_memory(needs)


def _numbers_in_cell(needs: Needs) -> float:
    """How many numbers are alive at the peak in each cell.

    Fitted to arrays that `benchmarks/memory.py --count` finds alive: some whatever the scene,
    others of every color, or varied field.
    """
    colors, rounds, more = needs.colors, needs.has_rounds, needs.moments - 1
    if needs.varied is None:
        of_color = 7 + 3 * needs.has_flux + 7 * needs.is_limited + rounds * (9 + 3 * more)
        return 19 + colors * of_color
    of_color = 11 + 8 * needs.has_flux + 29 * needs.is_limited + rounds * (20 + 4 * more)
    return 14 + 11 * needs.varied + colors * of_color


def _numbers_at_node(needs: Needs) -> float:
    """The same at each node that is marched at once."""
    if needs.varied is None:
        return 6 + 2 * needs.colors
    return 24 * needs.colors + 4 * needs.varied


def count_threads(device: torch.device) -> int:
    """In how many threads the engine's kernels add to copies of the same numbers on `device`."""
    is_shared = device.type == "cpu" and current_engine() == "warp"
    return torch.get_num_threads() if is_shared else 1


def shared_memory(needs: Needs) -> int:
    """Bytes of such copies at most, beyond those of two threads."""
    if needs.threads <= 2:
        return 0
    # What view rays meet: fields of matter and light, and the mass to each light.
    of_cells = needs.size * needs.cells * needs.colors * (MATTER + needs.lights)
    of_rays = min(spare.MOST_COPIED, (needs.threads - 2) * of_cells)
    piece = needs.size * piece_numbers(needs.shape, needs.colors, needs.moments)
    pieces = spare.count_shares(max(1, needs.threads // (2 * needs.colors)), piece, 1)
    return max(of_rays * (needs.varied is not None), pieces * piece * needs.has_rounds)


def _overhead(needs: Needs, is_short: bool) -> float:
    """How many times as much as is alive the process holds.

    Where arrays stay with the allocator it holds up to twice as much, for others of the same size.
    """
    largest = needs.size * needs.colors * needs.cells
    is_small = largest <= SMALL
    if is_short:
        return 1.3 if is_small else 1.15
    if needs.varied is None or largest > LARGEST:
        return 1.2
    return 1.9 if is_small else 1.55


def make_room(needs: Needs, device: torch.device) -> str | None:
    """What to say of a scene with such `needs` that does not fit into the free memory of `device`.

    None where it does. Where it barely does, freed memory is given back from now on.
    """
    free = free_memory(device)
    if free is None or memory_of(needs) <= free:
        return None
    is_short = device.type == "cpu"
    if is_short and memory_of(needs, is_short) <= free:
        give_freed_memory()
        return None
    place = "this machine" if device.type == "cpu" else "the GPU"
    fits = [words for words, other in _smaller(needs, free) if memory_of(other) <= free]
    return (
        f"takes about {gibibytes(memory_of(needs, is_short))}, but {place} has {gibibytes(free)} "
        f"free; this would fit: {', or '.join(fits) or 'nothing'}"
    )


def _smaller(needs: Needs, free: int) -> Iterator[tuple[str, Needs]]:
    """What could be given up, in the words of the command line."""
    if needs.size == 8:
        yield "--dtype float32", replace(needs, size=4)
    if needs.times > 1:
        yield "-D diffusion.refine=1", replace(needs, times=1)
    if needs.has_rounds:
        yield "-D diffusion.transport_rounds=0", replace(needs, has_rounds=False)
    if needs.is_limited:
        yield "-D diffusion.model=p1", replace(needs, is_limited=False)
    part, coarser = 1.0, needs
    while memory_of(coarser) > free and part > 1e-3:
        part *= 0.95
        x, y, z = (max(1, int(part * cells)) for cells in needs.resolution)
        coarser = replace(needs, resolution=(x, y, z))
    yield f"volume.resolution: [{', '.join(map(str, coarser.resolution))}]", coarser


def free_memory(device: torch.device) -> int | None:
    """Bytes that this process can still take on `device`, None if unknown.

    By what the system says, and its limits on groups of processes.
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
        if not hasattr(os, "sysconf"):
            return None
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def usable_cores(root: Path = GROUPS, own: Path = OWN_GROUPS) -> int:
    """How many cores this process may use, by its affinity and the quotas of its control groups."""
    is_limited = hasattr(os, "sched_getaffinity")
    cores = [len(os.sched_getaffinity(0)) if is_limited else os.cpu_count() or 1]
    for is_unified, group in _groups("cpu", root, own):
        names = ("cpu.max",) if is_unified else ("cpu.cfs_quota_us", "cpu.cfs_period_us")
        with suppress(OSError, ValueError):  # the latter of "max"
            quota, period = (int(n) for name in names for n in (group / name).read_text().split())
            if quota > 0:
                cores.append(math.ceil(quota / period))
    return min(cores)


def _group_limits(root: Path = GROUPS, own: Path = OWN_GROUPS) -> Iterator[int]:
    """Bytes left to each control group of this process."""
    for is_unified, group in _groups("memory", root, own):
        limit, usage, cached = UNIFIED if is_unified else DIVIDED
        with suppress(OSError, ValueError):
            allowed, used = (group / limit).read_text().strip(), int((group / usage).read_text())
            lines = (group / "memory.stat").read_text().splitlines()
            if allowed != "max":
                given_back = dict(line.split() for line in lines).get(cached, 0)
                yield int(allowed) - used + int(given_back)


def _groups(kind: str, root: Path, own: Path) -> Iterator[tuple[bool, Path]]:
    """The folders of the control groups of this `kind` that hold this process, inner ones first.

    And whether each is of Linux's second version, where groups of all kinds are one.
    """
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, kinds, path = line.split(":", 2)
        if not kinds or kind in kinds.split(","):
            top = root / kind if kinds else root
            for folder in (top / path.lstrip("/"), *(top / path.lstrip("/")).parents):
                yield not kinds, folder
                if folder == top:
                    break


def is_shortage(error: BaseException) -> bool:
    """Whether `error` is what Python or torch raise where they get no memory."""
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(
        words in str(error).lower() for words in SHORTAGES
    )


def gibibytes(amount: int) -> str:
    """`amount` bytes in words."""
    size = amount / 2**30
    if size >= 100:
        return f"{size:.0f} GiB"
    return f"{size:.3g} GiB" if size >= 1 else f"{amount / 2**20:.0f} MiB"
