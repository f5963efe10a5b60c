"""Launches of a sweep's kernels: directions go through all rows together, on a processor.

Each lane has memory of its own, and does a color and a way: up or down in z, which share one sum.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.launch import count_shares, launch_later
from ddrecon.kernels.text import TextKernel, declarations
from ddrecon.transport.fused.directions import LARGE, SLABS, make_tables, piece_numbers
from ddrecon.transport.fused.swept import Swept

_ROOM = "transport/fused"
MARGIN = 16
"""Cells before an array of rows, which begin where vectors do."""
NUMBERS = 7
"""Rows of a lane's own besides those of moments: two empty ones, and what the adjoint sums."""


class Rows:
    """The arrays of a sweep on a processor, and the launches of kernels on them.

    Of a sweep and its `changes`, what is found is the change of what is swept. More threads than
    all colors and ways need share directions, in pieces that have sums of their own.
    """

    def __init__(self, swept: Swept, changes: Swept | None = None):
        threads = torch.get_num_threads()
        self.swept, self.changes, self.like = swept, changes, swept.gradient[0]
        self.count, self.colors = swept.factors.shape
        self.depth, self.height, self.width = self.like.shape[1:]
        self.pitch = -(-(self.width + 2) // MARGIN) * MARGIN
        self.slab = SLABS[swept.grid.cells > LARGE]
        one = self.like.element_size() * piece_numbers(swept.grid.shape, self.colors, self.count)
        self.pieces = count_shares(max(1, threads // (2 * self.colors)), one, 1)
        self.together = max(1, min(threads // 2, self.colors))
        self.threads, self.lanes = threads, 2 * self.together * self.pieces
        self.tables = make_tables(
            swept.grid, swept.directions, self.count, self.pieces, self.like.dtype
        )
        # slabs begin anew in the middle, where the ways meet
        low, high = self.depth // 2, self.depth - self.depth // 2
        self.slabs = -(-low // self.slab) + -(-high // self.slab)
        fields = swept.fields
        if changes is not None:
            # Each with its change behind it: there is a medium where that changes, too.
            fields = [torch.cat(pair) for pair in zip(fields, changes.fields, strict=True)]
        self.fields = [field.contiguous() for field in fields]
        self.ranges, self.densest = find_ranges(self.fields)
        self.channels = [len(field) for field in swept.fields]

    def follow(
        self, is_saved: bool = False, varies_numbers: bool = False
    ) -> tuple[Tensor, Tensor | None]:
        """Moments of radiance less the first two of light, and what `transpose` is given.

        Moments are [K, C, z, y, x]. If it `is_saved`, that is I before slabs of slices,
        [C, directions, slabs, y, x].
        """
        if is_saved:
            launch_later(self._kernel("return_rows<", varies_numbers).kernel, self.like)
        shape = self.colors, self.swept.directions, self.slabs, self.height, self.width
        saved = self.like.new_empty(shape) if is_saved else None
        kinds = 2 if self.changes is None else 4
        lines = self.like.new_zeros(self._line_count(kinds, self.height + 2))
        kind = "F" if self.changes is None else "Dual<F>"
        kernel = self._kernel(f"follow_rows<{kind}, ")
        return self._run(kernel, {}, {"saved": saved, "lines": lines}), saved

    def transpose(
        self, saved: Tensor, bars: Sequence[Tensor | None], varies_numbers: bool
    ) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
        """Cotangents of `scales` [3, C], moments, gradient and fields, of those `bars` of light.

        `saved`: by `follow`.
        """
        shape = self.like.shape[1:]
        # One sum for colors at a time, or one for each.
        counts = [self.colors if each > 1 else self.together for each in self.channels]
        fields = [self.like.new_zeros(self.pieces, each, *shape) for each in counts]
        sums = self.like.new_zeros(self.colors, 2 * self.pieces, 3, dtype=torch.float64)
        gradient = self.like.new_zeros(self.pieces, 3, *self.like.shape)
        made = {
            "saved": saved, "sums": sums, "e_bar": fields[0], "sc_bar": fields[-1],
            "gradient_bar": gradient,
            "lines": self.like.new_empty(self._line_count(2, (self.slab + 1) * self.height)),
            "returning": self.like.new_zeros(self._line_count(2, self.height + 2)),
        }  # fmt: skip
        found = self._run(self._kernel("return_rows<", varies_numbers), {"bars": bars}, made)
        of_fields = [
            (bar[0] if len(bar) == 1 else bar.sum(0)).sum_to_size(each, *shape)
            for bar, each in zip(fields, self.channels, strict=True)
        ]
        gradient = gradient[0] if self.pieces == 1 else gradient.sum(0)
        return sums.sum(1).T.to(found.dtype), found, gradient, of_fields

    def _line_count(self, kinds: int, places: int) -> int:
        return self.lanes * (kinds * self.tables["most"] * self.pitch * places + MARGIN)

    def _kernel(self, function: str, *flags: bool) -> TextKernel:
        shares_field, degree = self.swept.scattering is None, round(self.count**0.5) - 1
        numbers = ", ".join(str(int(number)) for number in (degree, shares_field, *flags))
        return _kernel(f"{function}{numbers}>", 8 * self.like.itemsize)

    def _run(self, kernel: TextKernel, given: dict[str, Any], made: dict[str, Any]) -> Tensor:
        """Launches chunks, until the ways meet and from there on; the sums of moments."""
        swept = self.swept
        # Of each piece; zero where no direction of a piece goes.
        shape = self.pieces, self.count, *self.like.shape
        sums = self.like.new_empty(shape) if shape[0] == 1 else self.like.new_zeros(shape)
        numbers = self.tables["chunks"].shape[2]
        scratch_rows = NUMBERS + self.count
        scratch = self.like.new_zeros(self.lanes * scratch_rows * self.pitch)
        given = given | self.tables | {
            "light": swept.light, "source": swept.source, "factors": swept.factors,
            "light_low": swept.lows[0], "source_low": swept.lows[1],
            "scales": swept.scales,
            "extinction": self.fields[0], "extinction_channels": self.channels[0],
            "scattering": self.fields[-1], "scattering_channels": self.channels[-1],
            "gradient": swept.gradient, "ranges": self.ranges, "densest": self.densest,
            "depth": self.depth, "height": self.height, "width": self.width,
            "pitch": self.pitch, "margin": MARGIN, "colors": self.colors,
            "slab": self.slab, "slabs": self.slabs, "directions": swept.directions,
            "scratch_rows": scratch_rows, "pieces": self.pieces, "chunk_count": numbers,
            "together": self.together,
        }  # fmt: skip
        if (changes := self.changes) is not None:
            given |= {
                "d_light": changes.light, "d_source": changes.source,
                "d_factors": changes.factors, "d_scales": changes.scales,
                "d_gradient": changes.gradient,
            }  # fmt: skip
        bound = kernel.bind(given, made | {"found": sums, "scratch": scratch})
        halves = (1, 0) if "bars" in given else (0, 1)
        firsts = range(0, self.colors, self.together)
        for first, chunk, half in product(firsts, range(numbers), halves):
            count = 2 * self.pieces * min(self.together, self.colors - first)
            places = {"color_from": first, "chunk": chunk, "half": half}
            adds = int(chunk > 0 or half == halves[1])
            bound.launch(count, min(self.threads, count), **places, adds=adds)
        return sums.sum(0) if len(sums) > 1 else sums[0]


def find_ranges(fields: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """From and to where rows of `fields` [K, z, y, x] have a medium, [z, y, 2], and `densest`.

    They begin where vectors do; empty ones are from 0 to 0. `densest` [z, y]: the largest value of
    the first field.
    """
    width = fields[0].shape[-1]
    is_met = functools.reduce(torch.logical_or, ((field != 0).any(0) for field in fields))
    # How many cells there are from each end of a row to the last one that is not empty.
    count = torch.arange(1, width + 1, dtype=torch.int32)
    before, end = ((is_met * each).amax(-1) for each in (count.flip(0), count))
    begin = (width - before) // MARGIN * MARGIN * (end > 0)
    end = ((end + MARGIN - 1) // MARGIN * MARGIN).clamp(max=width)
    densest = fields[0].amax((0, 3)).clamp(min=0)
    return torch.stack([begin, end], -1).int(), densest


@functools.cache
def _kernel(function: str, bits: int) -> TextKernel:
    """The kernel of a `function(item, given)` in a header of this room.

    It is given what `Sweep` of `given.h` declares, and writes where pointers are not const.
    """
    text = Path(__file__).with_name("given.h").read_text(encoding="utf-8")
    (body,) = re.findall(r"struct Sweep {(.*?)\n};", text, re.DOTALL)
    body = " ".join(body.replace("* ", " *").split())
    made = ";".join(each for each in body.split(";") if "*" in each and "const" not in each)
    given = body.replace("const ", "")
    values = [
        f"{{{', '.join(f'{one}[{k}]' for k in range(count))}}}" if count else one
        for _, _, one, count in declarations(given)
    ]
    name = function.split("<")[0]
    return TextKernel(
        name,
        bits,
        f"{function}(item, Sweep<F>{{{', '.join(values)}}});",
        given,
        " ".join(one for _, _, one, _ in declarations(made)),
        f"{_ROOM}/{'rows' if name == 'follow_rows' else 'returning'}.h",
    )
