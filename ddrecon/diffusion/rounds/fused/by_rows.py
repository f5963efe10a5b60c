"""A sweep on a processor: jobs are colors and ways in z, one thread each.

The way up and the way down meet in the middle of the slices: of the rest each adds to what the
other has found. So both ways share one sum, and no moment is read but to be added to.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.kernels import follow_kernel, return_kernel
from ddrecon.diffusion.rounds.fused.rows import MARGIN, POINTERS
from ddrecon.diffusion.rounds.fused.schedule import make_tables
from ddrecon.diffusion.rounds.fused.surroundings import surround
from ddrecon.diffusion.rounds.fused.swept import Parts, Swept, moment_of
from ddrecon.kernels.spare import borrow, give_back
from ddrecon.kernels.text import TextKernel

MOST_OF_FEW, MOST = 8, 16
"""Directions at most that go through the cells together: of few moments, and of many.

More read many moments less often; fewer leave more of a cache to each.
"""
FEW = 4
SLABS = 4, 8
"""Slices at most of which all lines are kept for the adjoint; the second in large volumes.

Fewer fit into a cache, but more is saved before them.
"""
LARGE = 2**20
"""Cells of a large volume."""


@dataclass(frozen=True)
class Job:
    """Groups of directions through slices of a `color`, the way up (0) or down (1) in z.

    `lane`: whose memory it works in; `place`: of its color among those that go together.
    """

    color: int
    way: int
    piece: int
    lane: int
    groups: tuple[int, int]
    slices: tuple[int, int]
    is_adding: bool
    place: int


class Rows:
    """The arrays of a sweep on a processor, and the launches of kernels on them."""

    def __init__(self, swept: Swept, threads: int):
        self.swept, self.like = swept, swept.like
        self.count, self.colors = swept.factors.shape[1:]
        self.depth, self.height, self.width = self.like.shape[1:]
        self.held: list[Tensor] = []
        self.bits = torch.finfo(self.like.dtype).bits
        self.pitch = -(-(self.width + 2) // MARGIN) * MARGIN
        # Two threads do a color; more than all colors need share its directions.
        self.together = max(1, min(threads // 2, self.colors))
        self.pieces = max(1, threads // (2 * self.colors))
        self.threads = threads
        self.lanes = 1 if threads == 1 else 2 * self.together * self.pieces
        self.slab = SLABS[swept.grid.cells > LARGE]
        most = MOST_OF_FEW if self.count <= FEW else MOST
        self.tables = make_tables(
            swept.grid, swept.directions, self.count, most, self.pieces, self.like.dtype
        )
        self.slabs = max(len(self._slabs(way, (0, self.depth))) for way in (0, 1))
        fields = [f for f in (swept.extinction, swept.scattering) if f is not None]
        self.fields, self.ranges = surround(fields, self.pitch)
        self.channels = [len(field) for field in fields]

    def follow(self, is_saved: bool) -> tuple[Tensor, Tensor | None]:
        """The moments of radiance [K, C, z, y, x]; and what `transpose` needs, if it `is_saved`.

        That is I before slabs of slices, [C, directions, slabs, y, x].
        """
        sums = self._sums()
        shape = self.colors, self.swept.directions, self.slabs, self.height, self.width
        saved = self.like.new_empty(shape) if is_saved else None
        lines = self.like.new_zeros(self._line_count(self.height + 2))
        kernel = follow_kernel(self.bits, self._shares_field, False)
        values = self._given(lines) | {"found": sums, "saved": saved}
        for jobs in self._launches(is_backward=False):
            self._launch(kernel, jobs, values)
        return (sums.sum(0) if len(sums) > 1 else sums[0]), saved

    def transpose(
        self, saved: Tensor, bars: Parts, varies_numbers: bool
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Cotangents of `scales` [3, C], of moments and of fields, of those `bars` of light.

        `saved`: by `follow`, for as many threads.
        """
        sums = self._sums()
        lines = borrow(self._line_count((self.slab + 1) * self.height), self.like)
        kinds = 2 + len(self.fields)
        size = kinds * self.tables.most * self.pitch * (self.height + 2) + MARGIN
        shape = self.depth, self.height, self.width
        channels = [self._bar_channels(each) * self.pieces for each in self.channels]
        fields = [self.like.new_zeros(each, *shape) for each in channels]
        scales = self.like.new_zeros(2 * self.pieces, self.colors, 3, dtype=torch.float64)
        values = self._given(lines) | {
            "bars": self._addresses(moment_of(bars, k) for k in range(self.count)),
            "saved": saved, "found": sums, "sums": scales,
            "returning": self.like.new_zeros(self.lanes * size),
            "e_bar": fields[0], "sc_bar": fields[-1],
        }  # fmt: skip
        keep = follow_kernel(self.bits, self._shares_field, True)
        back = return_kernel(self.bits, self._shares_field, varies_numbers)
        for jobs in self._launches(is_backward=True):
            for slabs in zip_longest(*(self._slabs(job.way, job.slices) for job in jobs)):
                pairs = zip(jobs, slabs, strict=True)
                part = [replace(job, slices=slab) for job, slab in pairs if slab is not None]
                self._launch(keep, part, values)
                self._launch(back, part, values)
        give_back(lines)
        found = sums.sum(0) if len(sums) > 1 else sums[0]
        of_fields = [
            bar.unflatten(0, (self.pieces, -1)).sum(0).sum_to_size(each, *shape)
            for bar, each in zip(fields, self.channels, strict=True)
        ]
        return scales.sum(0).T.to(found.dtype), found, of_fields

    @property
    def _shares_field(self) -> bool:
        return self.swept.scattering is None

    def _line_count(self, places: int) -> int:
        return self.lanes * (2 * self.tables.most * self.pitch * places + MARGIN)

    def _bar_channels(self, channels: int) -> int:
        """How many sums a piece has of the cotangents of a field: one for colors at a time."""
        return self.colors if channels > 1 else self.together

    def _sums(self) -> Tensor:
        """Moments for each piece; of a piece without directions they stay zero."""
        shape = self.pieces, self.count, *self.like.shape
        return self.like.new_empty(shape) if self.pieces == 1 else self.like.new_zeros(shape)

    def _addresses(self, moments: Iterable[Tensor | None]) -> Tensor:
        """Where each of `moments` lies, in memory of its own; 0 for none."""
        held = [one if one is None else one.contiguous() for one in moments]
        self.held += [one for one in held if one is not None]
        return torch.tensor([0 if one is None else one.data_ptr() for one in held])

    def _given(self, lines: Tensor) -> dict[str, Any]:
        """What all kernels are given, by its names; `found`, `jobs` and cotangents are missing."""
        tables, like = self.tables, self.like
        scratch_rows = 3 * POINTERS + 5 + tables.most
        return {
            "moments": self._addresses(one for pair in self.swept.moments for one in pair),
            "factors": self.swept.factors, "slab": self.slab, "slabs": self.slabs,
            "directions": self.swept.directions,
            "extinction": self.fields[0],
            "scattering": self.fields[-1], "scales": self.swept.scales, "parts": tables.parts,
            "matrices": tables.matrices, "lines": lines, "ranges": self.ranges,
            "scratch": like.new_zeros(self.lanes * scratch_rows * self.pitch),
            "nothing": like.new_zeros(self.pitch + 2 * MARGIN),
            "groups": tables.groups, "points": tables.points, "pairs": tables.pairs,
            "order": tables.moments, "depth": self.depth, "height": self.height,
            "width": self.width, "pitch": self.pitch, "colors": self.colors, "count": self.count,
            "even": tables.even, "most": tables.most, "extinction_channels": self.channels[0],
            "scattering_channels": self.channels[-1], "scratch_rows": scratch_rows,
        }  # fmt: skip

    def _launches(self, is_backward: bool) -> Iterator[list[Job]]:
        """The jobs of each launch, of which none writes what another of them does."""
        chunks = self.tables.chunks
        for first in range(0, self.colors, self.together):
            colors = range(first, min(first + self.together, self.colors))
            for number in range(max(len(piece) for way in chunks for piece in way)):
                for phase in range(2):
                    # One thread does a way after the other; two meet in the middle.
                    ways = (phase,) if self.lanes == 1 else (0, 1)
                    yield [
                        Job(
                            color, way, piece,
                            lane=((color - first) * len(ways) + way % len(ways)) * self.pieces
                            + piece,
                            groups=chunks[way][piece][number],
                            slices=self._slices(way, phase, is_backward),
                            is_adding=number > 0 or phase > 0,
                            place=color - first,
                        )
                        for color in colors
                        for way in ways
                        for piece in range(len(chunks[way]))
                        if number < len(chunks[way][piece])
                    ]  # fmt: skip

    def _slices(self, way: int, phase: int, is_backward: bool) -> tuple[int, int]:
        """From and to which slice, as `way` counts them, a job goes in one of two phases."""
        if self.lanes == 1:
            return 0, self.depth
        is_first = (phase == 0) != is_backward
        return (0, self._middle(way)) if is_first else (self._middle(way), self.depth)

    def _middle(self, way: int) -> int:
        """How many slices there are before those that light on the other way comes to first."""
        return self.depth - self.depth // 2 if way else self.depth // 2

    def _slabs(self, way: int, slices: tuple[int, int]) -> list[tuple[int, int]]:
        """The slabs within `slices`, the last one first. They begin anew in the middle."""
        middle, found = self._middle(way), []
        for first, last in ((0, middle), (middle, self.depth)):
            if slices[0] <= first and last <= slices[1]:
                found += [(s, min(s + self.slab, last)) for s in range(first, last, self.slab)]
        return found[::-1]

    def _launch(self, kernel: TextKernel, jobs: list[Job], values: dict[str, Any]) -> None:
        rows = [self._row(job) for job in jobs]
        work = self.depth * self.height * self.width * self.tables.most * self.count
        given = values | {"jobs": torch.tensor(rows, dtype=torch.int32)}
        made = {"found": given.pop("found")}
        kernel.launch(len(jobs), given, made, min(self.threads, len(jobs)), work=work)

    def _row(self, job: Job) -> list[int]:
        """The numbers of a job, `rows.JOB` of them."""
        sums = (job.way * self.pieces + job.piece) * self.colors + job.color
        bars = []
        for channels in (self.channels[0], self.channels[-1]):
            own = job.color if channels > 1 else job.place
            bars.append(job.piece * self._bar_channels(channels) + own)
        way = -1 if job.way else 1
        numbers = [job.color, way, *job.groups, *job.slices, int(job.is_adding), job.lane]
        return [*numbers, sums, *bars, job.piece, self._middle(job.way)]
