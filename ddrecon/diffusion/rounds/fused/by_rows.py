"""A sweep on a processor: directions go through all rows together, each job in a lane of its own.

The way up and the way down in z share one sum, and no moment is read but to be added to.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.jobs import MOST, MOST_OF_FEW, SLABS, Lanes, Phase, plan
from ddrecon.diffusion.rounds.fused.kernels import follow_kernel, return_kernel
from ddrecon.diffusion.rounds.fused.rows import MARGIN, POINTERS
from ddrecon.diffusion.rounds.fused.schedule import make_tables
from ddrecon.diffusion.rounds.fused.surroundings import surround
from ddrecon.diffusion.rounds.fused.swept import Parts, Swept
from ddrecon.kernels.spare import borrow, give_back
from ddrecon.kernels.text import TextKernel

FEW = 4
LARGE = 2**20
"""Cells of a large volume."""


class Rows:
    """The arrays of a sweep on a processor, and the launches of kernels on them."""

    def __init__(self, swept: Swept, threads: int):
        self.swept, self.like = swept, swept.like
        self.count, self.colors = swept.factors.shape
        self.depth, self.height, self.width = self.like.shape[1:]
        self.bits = torch.finfo(self.like.dtype).bits
        self.pitch = -(-(self.width + 2) // MARGIN) * MARGIN
        self.slab = SLABS[swept.grid.cells > LARGE]
        most = MOST_OF_FEW if self.count <= FEW else MOST
        size = self.like.element_size()
        self.lanes = Lanes.that_fit(threads, self.colors, swept.grid.shape, self.count, size)
        self.tables = make_tables(
            swept.grid, swept.directions, self.count, most, self.lanes.pieces, self.like.dtype
        )
        # slabs begin anew in the middle, where the ways meet
        low, high = self.depth // 2, self.depth - self.depth // 2
        self.slabs = -(-low // self.slab) + -(-high // self.slab)
        self.fields, self.ranges, self.densest = surround(self._matter(), self.pitch)
        self.channels = [len(field) for field in swept.fields]

    def follow(self, is_saved: bool) -> tuple[Tensor, Tensor | None]:
        """Moments of radiance less those of light; and what `transpose` needs, if it `is_saved`.

        Moments are [K, C, z, y, x], and of light only the first two are taken. `transpose` needs
        I before slabs of slices, [C, directions, slabs, y, x].
        """
        shape = self.colors, self.swept.directions, self.slabs, self.height, self.width
        saved = self.like.new_empty(shape) if is_saved else None
        sums, lines = self._sums(), self._line_count(self.height + 2)
        given, made = self._given(), {"found": sums, "saved": saved, **self._zeros(lines=lines)}
        self._launch(follow_kernel(self.bits, self._shares_field), False, given, made)
        return (sums.sum(0) if len(sums) > 1 else sums[0]), saved

    def transpose(
        self, saved: Tensor, bars: Parts, varies_numbers: bool
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Cotangents of `scales` [3, C], of moments and of fields, of those `bars` of light.

        `saved`: by `follow`, for as many threads.
        """
        sums, lanes = self._sums(), self.lanes
        lines = borrow(self._line_count((self.slab + 1) * self.height), self.like)
        kinds, shape = 2 + len(self.fields), self.like.shape[1:]
        returning = kinds * self.tables.most * self.pitch * (self.height + 2) + MARGIN
        # one sum for colors at a time, or one for each
        channels = [lanes.colors if each > 1 else lanes.together for each in self.channels]
        fields = [self.like.new_zeros(lanes.pieces, each, *shape) for each in channels]
        scales = self.like.new_zeros(2 * lanes.pieces, lanes.colors, 3, dtype=torch.float64)
        made = {
            "found": sums, "sums": scales, "e_bar": fields[0], "sc_bar": fields[-1],
            "lines": lines, **self._zeros(returning=lanes.number * returning),
        }  # fmt: skip
        kernel = return_kernel(self.bits, self._shares_field, varies_numbers)
        given = self._given() | {"bars": bars, "saved": saved}
        self._launch(kernel, True, given, made)
        give_back(lines)
        found = sums.sum(0) if len(sums) > 1 else sums[0]
        of_fields = [
            (bar[0] if len(bar) == 1 else bar.sum(0)).sum_to_size(each, *shape)
            for bar, each in zip(fields, self.channels, strict=True)
        ]
        return scales.sum(0).T.to(found.dtype), found, of_fields

    def _matter(self) -> list[Tensor]:
        """The fields that steps meet."""
        return self.swept.fields

    @property
    def _shares_field(self) -> bool:
        return self.swept.scattering is None

    def _line_count(self, places: int) -> int:
        return self.lanes.number * (2 * self.tables.most * self.pitch * places + MARGIN)

    def _sums(self) -> Tensor:
        """Moments for each piece; zero where no direction of a piece goes."""
        shape = self.lanes.pieces, self.count, *self.like.shape
        return self.like.new_empty(shape) if shape[0] == 1 else self.like.new_zeros(shape)

    def _zeros(self, **sizes: int) -> dict[str, Tensor]:
        """Zeros by their names, with what kernels work in and an empty row."""
        scratch = self.lanes.number * self._scratch_rows * self.pitch
        sizes |= {"scratch": scratch, "nothing": self.pitch + 2 * MARGIN}
        whole = {name: -(-size // MARGIN) * MARGIN for name, size in sizes.items()}
        parts = self.like.new_zeros(sum(whole.values())).split(list(whole.values()))
        return dict(zip(whole, parts, strict=True))

    @property
    def _scratch_rows(self) -> int:
        return 3 * POINTERS + 5 + self.tables.most

    def _given(self) -> dict[str, Any]:
        """What both kernels are given, by its names, but for what they write."""
        tables, swept = self.tables, self.swept
        return {
            "light_parts": swept.light, "source_parts": swept.source, "factors": swept.factors,
            "beam_factors": swept.beam_factors,
            "slab": self.slab, "slabs": self.slabs, "directions": swept.directions,
            "extinction": self.fields[0], "scattering": self.fields[-1],
            "scales": swept.scales, "parts": tables.parts, "matrices": tables.matrices,
            "ranges": self.ranges, "densest": self.densest,
            "groups": tables.groups, "points": tables.points,
            "pairs": tables.pairs, "order": tables.moments, "depth": self.depth,
            "height": self.height, "width": self.width, "pitch": self.pitch,
            "colors": self.colors, "count": self.count, "even": tables.even, "most": tables.most,
            "extinction_channels": self.channels[0], "scattering_channels": self.channels[-1],
            "scratch_rows": self._scratch_rows,
        }  # fmt: skip

    def _launch(
        self, kernel: TextKernel, is_backward: bool, given: dict[str, Any], made: dict[str, Any]
    ) -> None:
        """Does all jobs."""
        count, work = self.lanes.number, self.like.numel() * self.tables.most * self.count
        bound = kernel.bind(given, made)
        phase: Phase
        for phase in plan(self.lanes, self.tables.chunks, self.depth, is_backward):
            bound.launch(count, count, work, jobs=phase.jobs, starts=phase.starts)
