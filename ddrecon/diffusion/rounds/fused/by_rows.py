"""A sweep on a processor: directions go through all rows together, each job in a lane of its own.

The way up and the way down in z share one sum, and no moment is read but to be added to.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.jobs import MOST, MOST_OF_FEW, SLABS, Lanes, plan
from ddrecon.diffusion.rounds.fused.records import struct_kernel
from ddrecon.diffusion.rounds.fused.schedule import make_tables
from ddrecon.diffusion.rounds.fused.surroundings import MARGIN, surround
from ddrecon.diffusion.rounds.fused.swept import Parts, Swept
from ddrecon.kernels.spare import borrow, give_back
from ddrecon.kernels.text import TextKernel

FEW = 4
LARGE = 2**20
"""Cells of a large volume."""
NUMBERS = 7
"""Rows of a lane's own besides those of directions and of moments: two empty ones, and what the
adjoint sums."""


class Rows:
    """The arrays of a sweep on a processor, and the launches of kernels on them.

    Of a sweep and its `changes`, what is found is the change of what is swept.
    """

    def __init__(self, swept: Swept, threads: int, changes: Swept | None = None):
        self.swept, self.changes, self.like = swept, changes, swept.like
        self.count, self.colors = swept.factors.shape
        self.depth, self.height, self.width = self.like.shape[1:]
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
        fields = swept.fields
        if changes is not None:
            # Each with its change behind it: steps meet a medium where that changes, too.
            fields = [torch.cat(pair) for pair in zip(fields, changes.fields, strict=True)]
        self.fields, self.ranges, self.densest = surround(fields, self.pitch)
        self.channels = [len(field) for field in swept.fields]

    def follow(self, is_saved: bool = False) -> tuple[Tensor, Tensor | None]:
        """Moments of radiance less those of light; and what `transpose` needs, if it `is_saved`.

        Moments are [K, C, z, y, x], and of light only the first two are taken. `transpose` needs
        I before slabs of slices, [C, directions, slabs, y, x].
        """
        shape = self.colors, self.swept.directions, self.slabs, self.height, self.width
        saved = self.like.new_empty(shape) if is_saved else None
        kinds = 2 if self.changes is None else 4
        made = self._zeros(lines=self._line_count(kinds, self.height + 2))
        kind = "F" if self.changes is None else "Dual<F>"
        return self._run(f"follow_rows<{kind}, ", "", {}, {"saved": saved, **made}), saved

    def transpose(
        self, saved: Tensor, bars: Parts, varies_numbers: bool
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Cotangents of `scales` [3, C], of moments and of fields, of those `bars` of light.

        `saved`: by `follow`, for as many threads.
        """
        lanes, shape = self.lanes, self.like.shape[1:]
        lines = borrow(self._line_count(2, (self.slab + 1) * self.height), self.like)
        # one sum for colors at a time, or one for each
        channels = [lanes.colors if each > 1 else lanes.together for each in self.channels]
        fields = [self.like.new_zeros(lanes.pieces, each, *shape) for each in channels]
        scales = self.like.new_zeros(2 * lanes.pieces, lanes.colors, 3, dtype=torch.float64)
        made = {
            "saved": saved, "sums": scales, "e_bar": fields[0], "sc_bar": fields[-1],
            "lines": lines,
            **self._zeros(returning=self._line_count(2 + len(fields), self.height + 2)),
        }  # fmt: skip
        flag = f", {str(varies_numbers).lower()}"
        found = self._run("return_rows<", flag, {"bars": bars}, made)
        give_back(lines)
        of_fields = [
            (bar[0] if len(bar) == 1 else bar.sum(0)).sum_to_size(each, *shape)
            for bar, each in zip(fields, self.channels, strict=True)
        ]
        return scales.sum(0).T.to(found.dtype), found, of_fields

    def _line_count(self, kinds: int, places: int) -> int:
        return self.lanes.number * (kinds * self.tables.most * self.pitch * places + MARGIN)

    def _zeros(self, **sizes: int) -> dict[str, Tensor]:
        """Zeros by their names, with what kernels work in."""
        sizes |= {"scratch": self.lanes.number * self._scratch_rows * self.pitch}
        whole = {name: -(-size // MARGIN) * MARGIN for name, size in sizes.items()}
        parts = self.like.new_zeros(sum(whole.values())).split(list(whole.values()))
        return dict(zip(whole, parts, strict=True))

    @property
    def _scratch_rows(self) -> int:
        return NUMBERS + self.tables.most + self.count

    def _run(
        self, function: str, flags: str, given: dict[str, Any], made: dict[str, Any]
    ) -> Tensor:
        """Does all jobs; the sums of moments."""
        swept, tables = self.swept, self.tables
        # Of each piece; zero where no direction of a piece goes.
        shape = self.lanes.pieces, self.count, *self.like.shape
        sums = self.like.new_empty(shape) if shape[0] == 1 else self.like.new_zeros(shape)
        given = given | {
            "light_parts": swept.light, "source_parts": swept.source, "factors": swept.factors,
            "beam_factors": swept.beam_factors, "scales": swept.scales,
            "extinction": self.fields[0], "extinction_channels": self.channels[0],
            "scattering": self.fields[-1], "scattering_channels": self.channels[-1],
            "ranges": self.ranges, "densest": self.densest,
            "groups": tables.groups, "courses": tables.courses, "parts": tables.parts,
            "pairs": tables.pairs, "matrices": tables.matrices, "order": tables.order,
            "depth": self.depth, "height": self.height, "width": self.width,
            "pitch": self.pitch, "margin": MARGIN, "colors": self.colors, "most": tables.most,
            "slab": self.slab, "slabs": self.slabs, "directions": swept.directions,
            "scratch_rows": self._scratch_rows,
        }  # fmt: skip
        if (changes := self.changes) is not None:
            given |= {
                "d_light_parts": changes.light, "d_source_parts": changes.source,
                "d_factors": changes.factors, "d_scales": changes.scales,
            }  # fmt: skip
        degree, shares_field = round(self.count**0.5) - 1, str(swept.scattering is None).lower()
        whole = f"{function}{degree}, {shares_field}{flags}>"
        bound = _kernel(whole, torch.finfo(self.like.dtype).bits).bind(
            given, made | {"found": sums}
        )
        count, work = self.lanes.number, self.like.numel() * tables.most * self.count
        is_backward = "bars" in given
        for phase in plan(self.lanes, tables.chunks, self.depth, is_backward):
            bound.launch(count, count, work, jobs=phase.jobs, starts=phase.starts)
        return sums.sum(0) if len(sums) > 1 else sums[0]


@functools.cache
def _kernel(function: str, bits: int) -> TextKernel:
    header = "rows.h" if function.startswith("follow") else "returning.h"
    return struct_kernel(function.split("<")[0], bits, header, "Sweep", function)
