"""How much memory a scene takes, before any of it is taken; what memory and cores there are."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import torch

from ddrecon.numerics.sphere import count_harmonics
from ddrecon.settings import DiffusionSettings

GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
"""The control groups of Linux, and the file that names those of this process."""
LIMITS = {"memory.max": "anon", "memory.limit_in_bytes": "total_rss"}
"""The limit of a group, by either version, and the memory in use in its memory.stat, caches apart.
"""
QUOTAS = (["cpu.max"], ["cpu.cfs_quota_us", "cpu.cfs_period_us"])
"""The files of a group's quota and period of processor time, by either version."""
OVERHEAD = 1.5
"""How many times as much as is alive the process holds."""
IN_PIXEL = 18
"""Numbers of a pixel: targets, those of a coarser level, what view rays meet, renders."""
SHORTAGE = "(out of|not enough) memory|(can.t|failed to) allocate|bad.?alloc|alloc_(cpu|failed)"
"""What torch and Warp say, in one place or another, where they get no memory."""
_latest: list[Needs] = []
"""The needs of the scene that was built last: a shortage may come anywhere later."""


@dataclass(frozen=True)
class Needs:
    """What the memory of a scene depends on.

    `resolution` (x, y, z), the `numbers` alive in a cell, `pixels` of all views, and `size`: bytes
    of a number.
    """

    resolution: tuple[int, ...]
    numbers: float
    pixels: int
    size: int

    @property
    def total(self) -> int:
        """Bytes that rendering all views takes at its peak, without torch itself."""
        alive = self.numbers * math.prod(self.resolution) + IN_PIXEL * self.pixels
        return int(OVERHEAD * self.size * alive)

    @property
    def of_pixels(self) -> int:
        """Those of them that pixels take."""
        return replace(self, resolution=(0, 0, 0)).total

    def smaller(self, limit: int) -> Iterator[str]:
        """What takes at most `limit` bytes, in the words of the command line and scene file."""
        if self.size == 8 and self.total <= 2 * limit:
            yield "--dtype float32"
        pixels, cells = self.of_pixels, self.total - self.of_pixels
        share = (max(0, limit - pixels) / cells) ** (1 / 3)
        coarser = [int(share * cells_along) for cells_along in self.resolution]
        if min(coarser) > 0:
            yield f"volume.resolution: {coarser}"
        if pixels and cells < limit:
            share = math.sqrt((limit - cells) / pixels)
            yield f"images of {math.floor(100 * share)}% the width and height"


def numbers_in_cell(
    colors: int, varied: int, is_directed: bool, settings: DiffusionSettings
) -> float:
    """How many numbers are alive in each cell of light at the peak, of which so many are `varied`.

    `is_directed`: whether light scatters unevenly. The coefficients were fitted to
    counts; `benchmarks/memory.py` compares what follows with the memory of processes.
    """
    moments = count_harmonics(settings.angles) if is_directed else 1
    rendered = 18 + 1.5 * moments
    if settings.model == "flux_limited":
        rendered += 12
    elif settings.rounds:
        rendered += 13 + 1.2 * moments
    if settings.receive:
        # Before, cells receive suns in parts.
        rendered = max(rendered, 10 * settings.receive**3)
    return colors * rendered * (2 if varied else 1) + 38 * varied


def refuse_excess(needs: Needs, device: torch.device) -> str | None:
    """What to say of a scene whose `needs` exceed the free memory of `device`; None if it fits."""
    _latest[:] = [needs]
    free = free_memory(device)
    if free is None or needs.total <= free:
        return None
    place = "this machine" if device.type == "cpu" else "the GPU"
    return (
        f"takes about {gibibytes(needs.total)}, but {place} has {gibibytes(free)} free; "
        f"this would fit: {', or '.join(needs.smaller(free)) or 'nothing'}"
    )


def explain_shortage(error: BaseException) -> str | None:
    """One line on an `error` of Python or torch that get no memory; None of other errors."""
    text = str(error)
    if not isinstance(error, MemoryError) and not re.search(SHORTAGE, text, re.IGNORECASE):
        return None
    amount = re.search(r"allocate ([\d.]+ (?:[KMGT]i?B|bytes))", text)
    line = f"out of memory: {amount[1] if amount else 'what is needed next'} is not free"
    # More was needed than predicted: how much more is unknown, so what is said to fit takes half.
    fits = ", or ".join(word for needs in _latest for word in needs.smaller(needs.total // 2))
    return f"{line}; this would fit: {fits or 'fewer cells of volume.resolution, smaller images'}"


def free_memory(device: torch.device) -> int | None:
    """Bytes free on `device`, by the system and by limits of control groups; None if unknown."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return int(free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device))
    amounts = []
    with suppress(OSError, ValueError):
        [kibibytes] = re.findall(r"MemAvailable: *(\d+)", Path("/proc/meminfo").read_text())
        amounts.append(1024 * int(kibibytes))
    for folder, (limit, used) in product(_control_groups(), LIMITS.items()):
        with suppress(OSError, ValueError):  # "max" is no number
            statistics = (folder / "memory.stat").read_text()
            [in_use] = re.findall(rf"^{used} (\d+)$", statistics, re.MULTILINE)
            amounts.append(int((folder / limit).read_text()) - int(in_use))
    return min(amounts, default=None)


def usable_cores() -> int:
    """How many cores this process may use, by its affinity and the quotas of its control groups."""
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = [len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1]
    for folder, names in product(_control_groups(), QUOTAS):
        with suppress(OSError, ValueError):  # "max" is no number
            quota, period = map(int, " ".join((folder / n).read_text() for n in names).split())
            cores += [math.ceil(quota / period)] * (quota > 0)
    return min(cores)


def _control_groups() -> Iterator[Path]:
    """The folders of all control groups that hold this process."""
    lines = OWN_GROUPS.read_text().splitlines() if OWN_GROUPS.exists() else []
    for _, kinds, path in (line.split(":", 2) for line in lines):
        top = GROUPS / kinds  # version 2 has no kinds: all its groups are in one tree
        inner = top / path.lstrip("/")
        yield from (folder for folder in (inner, *inner.parents) if folder.is_relative_to(top))


def gibibytes(amount: int) -> str:
    """`amount` bytes in words."""
    size, unit = (amount / 2**30, "GiB") if amount >= 2**30 else (amount / 2**20, "MiB")
    return f"{size:.0f} {unit}" if size >= 100 else f"{size:.3g} {unit}"
