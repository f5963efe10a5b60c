"""How a volume is laid out for what goes through it.

What repeats without end (E2.15) is laid out as far as a computation reaches: what knows no periods
works in a wider grid, and gives up what stands beyond the first one. What goes slice by slice meets
slices across an axis in their order; of the two axes in a slice the lower one counts rows. Arrays
of cells are `[K, z, y, x]`, of slices `[N, K, rows, columns]`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid

FARTHEST = 16
"""Light is followed through periods for so many times the longest side of the box: light that goes
nearly along all periodic axes comes by no face.
"""
MARGIN = 4
"""Cells beyond those that a beam passes, which interpolation reaches."""


@dataclass(frozen=True)
class Unrolled:
    """So many cells more `before` and `after` a period of a `grid`, along z, y and x."""

    grid: Grid
    before: tuple[int, ...]
    after: tuple[int, ...]

    @functools.cached_property
    def wide(self) -> Grid:
        """All of these cells, as a grid that does not repeat; where nothing does, the same."""
        grid = self.grid
        if not any(self.before + self.after):
            return grid
        axes = zip(
            self.before, grid.shape, self.after, grid.lower, grid.upper, grid.spacing, strict=True
        )
        wide = (
            (low + count + high, lower - low * step, upper + high * step)
            for low, count, high, lower, upper, step in axes
        )
        return Grid(*zip(*wide, strict=True))

    def extend(self, field: Tensor) -> Tensor:
        """`field` [..., z, y, x] of a period in all cells."""
        for axis, (low, high) in enumerate(zip(self.before, self.after, strict=True)):
            if low or high:
                # Cut, not indexed: sums on the way back have a fixed order.
                count, place, pieces = field.shape[axis - 3], -low, list[Tensor]()
                while place < (end := count + high):
                    length = min(count - place % count, end - place)
                    pieces.append(field.narrow(axis - 3, place % count, length))
                    place += length
                field = torch.cat(pieces, axis - 3)
        return field

    def crop(self, field: Tensor) -> Tensor:
        """The first period of what is in all cells."""
        for axis, (low, count) in enumerate(zip(self.before, self.grid.shape, strict=True)):
            field = field.narrow(axis - 3, low, count)
        return field


@functools.lru_cache(maxsize=64)
def unroll(grid: Grid, reach: int) -> Unrolled:
    """So many cells more on both sides of a period."""
    around = tuple(reach * (axis in grid.periodic) for axis in range(3))
    return Unrolled(grid, around, around)


def unroll_along(grid: Grid, direction: Tensor, is_both: bool = False) -> Unrolled:
    """What light along `direction` [3] passes on its way to the cells of a period of `grid`.

    And, if `is_both`, on its way from there.
    """
    speed = [cosine / step for cosine, step in zip(direction.tolist(), grid.spacing, strict=True)]
    times = [
        n / max(abs(s), 1e-30)
        for axis, (n, s) in enumerate(zip(grid.shape, speed, strict=True))
        if axis not in grid.periodic
    ]
    time = min(*times, FARTHEST * max(grid.extent))
    before, after = [0, 0, 0], [0, 0, 0]
    for axis in grid.periodic:
        # Whole cells stay whole whatever rounding adds: where beams enter depends on their number.
        drift = math.ceil(abs(speed[axis]) * time - 1e-3)
        before[axis] = MARGIN + drift * (is_both or speed[axis] > 0)
        after[axis] = MARGIN + drift * (is_both or speed[axis] < 0)
    return Unrolled(grid, tuple(before), tuple(after))


def apply_around(function: Callable[[Tensor], Tensor], field: Tensor, grid: Grid) -> Tensor:
    """`function` of a `field` [..., z, y, x], which sees cells and those beside them."""
    if not grid.periodic:
        return function(field)
    period = unroll(grid, 1)
    return period.crop(function(period.extend(field)))


NEARLY = 1e-9
"""Drifts this near to none or to a whole cell are taken as that: they need no interpolation."""


def across(axis: int) -> tuple[int, int]:
    """The axes along which rows and columns of the slices across `axis` are counted."""
    row, column = (in_slice for in_slice in range(3) if in_slice != axis)
    return row, column


@dataclass(frozen=True)
class Slicing:
    """Slices across `axis` (0, 1, 2 for z, y, x), the last one first where it `is_reversed`.

    `order` holds the dimensions of an array of cells in the order that an array of slices has.
    """

    axis: int
    order: tuple[int, int, int, int]
    is_reversed: bool

    @staticmethod
    def of(speed: Sequence[float], periodic: tuple[int, ...] = ()) -> Slicing:
        """Slices across the axis along which light of `speed` [cells/u] along z, y, x is fastest.

        Light meets the slices in their order. Of axes crossed equally fast it is the first, those
        that are `periodic` last.
        """
        later = [NEARLY * (1 + a) * (a in periodic) for a in range(3)]
        axis = max(range(3), key=lambda a: abs(speed[a]) * (1 - later[a]))
        row, column = across(axis)
        return Slicing(axis, (1 + axis, 0, 1 + row, 1 + column), speed[axis] < 0)

    def lay(self, cells: Tensor) -> Tensor:
        """The slices `[N, K, rows, columns]` of `cells` [K, z, y, x]."""
        slices = cells.permute(self.order)
        return slices.flip(0) if self.is_reversed else slices

    def lift(self, slices: Tensor) -> Tensor:
        """The cells `[K, z, y, x]` that `lay` makes `slices` [N, K, rows, columns] of."""
        slices = slices.flip(0) if self.is_reversed else slices
        return slices.permute([self.order.index(dim) for dim in range(4)])
