"""A volume as slices across one of its axes, in the order in which light meets them.

The one convention for all that goes through a volume slice by slice: of the two axes in a slice the
lower one counts rows. Arrays of cells are `[K, z, y, x]`, of slices `[N, K, rows, columns]`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

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
        axis = max(range(3), key=lambda a: abs(speed[a]) * (1 - NEARLY * (a in periodic)))
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
