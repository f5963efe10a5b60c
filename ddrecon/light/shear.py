"""The mass that light passes on its way to each cell, by a shear of the grid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.running_sum import running_sum
from ddrecon.numerics.separable import Weights, sample_lattice
from ddrecon.numerics.third_order import ThirdOrder


def sum_mass_to_cells(
    field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float = 0.0
) -> tuple[Tensor, Tensor]:
    """The integral of `field` from the box to where a beam enters each cell's slice, and its path
    length within a slice [u].

    `field`: [K, z, y, x]; `direction`: [3], unit, array order, the way light travels. Slices are
    those across the axis along which the beam crosses most cells. Outside the box the field falls
    to zero within half a cell, which keeps the mass of the outer half cells. The sum over slices is
    exact for light along an axis; for slanted light it is refined by planes between them, and
    carried back to cells to third order, by corrections bounded by 1 / `bound`. Returns `[K, z, y,
    x]` and a scalar.
    """
    if field.shape[0] == 1:
        return _sum_mass(field, grid, direction, bound)
    each = [recompute(_sum_mass, one, grid, direction, bound) for one in field.split(1)]
    return torch.cat([entered for entered, _ in each]), each[0][1]


def _sum_mass(
    field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float
) -> tuple[Tensor, Tensor]:
    """What `sum_mass_to_cells` returns, of one field [1, z, y, x]."""
    speed = direction / direction.new_tensor(grid.spacing)
    axis = int(speed.detach().abs().argmax())
    order = [axis + 1, 0] + [1 + other for other in range(3) if other != axis]
    slices = field.permute(order)
    is_reversed = bool(direction[axis] < 0)
    if is_reversed:
        slices = slices.flip(0)
    slope = torch.stack([speed[other] for other in range(3) if other != axis]) / speed[axis].abs()
    step = grid.spacing[axis] / direction[axis].abs()
    shear = _Shear.of(slices, slope)
    centers, middles = shear.there(slices, 0.0), shear.there(0.5 * (slices[1:] + slices[:-1]), 0.5)
    bends = middles - 0.5 * (centers[1:] + centers[:-1])
    finer = running_sum(torch.cat([torch.zeros_like(centers[:1]), bends])) * (0.5 * step)
    smooth = ThirdOrder(0, 1, bound)
    entered = shear.back((running_sum(centers) - centers) * step + smooth.bounded(finer), smooth)
    if is_reversed:
        entered = entered.flip(0)
    return entered.permute([order.index(dim) for dim in range(4)]), step


@dataclass(frozen=True)
class _Shear:
    """Slices of `size` cells on a `lattice` that holds all of them, slice k shifted by -k `slope`
    cells, slice 0 beginning at `first`.
    """

    slope: Tensor
    size: tuple[int, int]
    lattice: tuple[int, int]
    first: tuple[int, int]

    @staticmethod
    def of(slices: Tensor, slope: Tensor) -> _Shear:
        """That of `slices` [N, K, H, W]."""
        height, width = slices.shape[2:]
        rows, columns = (
            math.floor(abs(s) * (slices.shape[0] - 1) + 1e-9) + 1 for s in slope.tolist()
        )
        is_on = [s > 0 for s in slope.tolist()]
        return _Shear(
            slope,
            (height, width),
            (height + rows, width + columns),
            (rows * is_on[0], columns * is_on[1]),
        )

    def there(self, slices: Tensor, shift: float) -> Tensor:
        """`slices` [N, K, H, W], numbered from `shift`, on the lattice; they fall to zero one cell
        beyond their outermost centers.
        """
        places = self._places(slices, shift, self.lattice, self.size, 1)
        rows, columns = (
            Weights.at(place, size, fades=True)
            for place, size in zip(places, self.size, strict=True)
        )
        return sample_lattice(slices, rows, columns).unflatten(-1, self.lattice)

    def back(self, sheared: Tensor, smooth: ThirdOrder) -> Tensor:
        """Slices of values `sheared` on the lattice, in cells again."""
        places = self._places(sheared, 0.0, self.size, self.lattice, -1)
        rows, columns = (
            Weights.at(place, size, is_smooth=True)
            for place, size in zip(places, self.lattice, strict=True)
        )
        return sample_lattice(sheared, rows, columns, smooth).unflatten(-1, self.size)

    def _places(
        self, like: Tensor, shift: float, points: tuple[int, int], cells: tuple[int, int], sign: int
    ) -> list[Tensor]:
        """Where rows and columns of `points` fall among those of `cells`, slice by slice, in [-1,
        1].
        """
        index = torch.arange(like.shape[0], dtype=like.dtype, device=like.device) + shift
        lines = []
        for slope, first, count, size in zip(self.slope, self.first, points, cells, strict=True):
            drift = sign * (index * slope - first)
            position = drift[:, None] + torch.arange(count, dtype=like.dtype, device=like.device)
            lines.append((2 * position + 1) / size - 1)
        return lines
