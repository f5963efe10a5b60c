"""The quadratic that total variation lies under: what smoothing says of a field, as a Gaussian.

The length of a slope, |s|, lies below (|s|^2 / |s0| + |s0|) / 2, and touches it at the slope s0
that the field has (lagged diffusivity: Vogel and Oman 1996, doi:10.1137/0917016). So about a
field total variation is half of x^T R x, R = D^T V D (E11.2): D takes slopes, V has the weight over
the length of each cell's slope. Along an edge it hardly holds, where a field is flat it holds most.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.losses import ROUNDING, compress, compressed_slope

AXES = (-3, -2, -1)


@dataclass(frozen=True)
class Roughness:
    """R = D^T V D of a field on `grid` (E11.2); `stiffness` >= 0 [..., z, y, x] is V of a cell."""

    grid: Grid
    stiffness: Tensor

    @staticmethod
    def about(field: Tensor, grid: Grid, weight: float, knee: float | None = None) -> Roughness:
        """That of `weight` times `losses.total_variation`, about `field` [..., z, y, x].

        Where that is of a field compressed above `knee` (E11.3), its slopes are those of the field
        times the slope of the compression there.
        """
        seen = field if knee is None else compress(field, knee)
        square = torch.stack([slope.square() for slope in slopes(seen, grid)]).sum(0)
        stiffness = weight / field.numel() / (square + ROUNDING**2).sqrt()
        if knee is not None:
            stiffness = stiffness * compressed_slope(field, knee) ** 2
        return Roughness(grid, stiffness)

    def times(self, factor: float) -> Roughness:
        """That of `factor` times the weight."""
        return Roughness(self.grid, factor * self.stiffness)

    def product(self, change: Tensor) -> Tensor:
        """R times `change` [..., z, y, x]."""
        return join_slopes([self.stiffness * s for s in slopes(change, self.grid)], self.grid)

    def root_product(self, noises: list[Tensor]) -> Tensor:
        """D^T V^(1/2) times `noises`, a field for each axis; of white ones its covariance is R."""
        return join_slopes([self.stiffness.sqrt() * noise for noise in noises], self.grid)

    def conductances(self) -> list[Tensor]:
        """What holds neighbors together, along each axis: one entry shorter than cells there."""
        return [
            self.stiffness.narrow(axis, 0, self.stiffness.shape[axis] - 1) * factor**2
            for axis, factor in zip(AXES, _factors(self.grid), strict=True)
        ]

    def diagonal(self) -> Tensor:
        """The diagonal of R."""
        total = torch.zeros_like(self.stiffness)
        for axis, each in zip(AXES, self.conductances(), strict=True):
            total.narrow(axis, 0, each.shape[axis]).add_(each)
            total.narrow(axis, 1, each.shape[axis]).add_(each)
        return total


def stiffness_diagonal(field: Tensor, grid: Grid, knee: float | None = None) -> Tensor:
    """h, where smoothing weighs 1, at `field` [..., z, y, x] compressed above `knee` (E11.3).

    That is the diagonal of R (E11.2); None is without compression.
    """
    seen = field if knee is None else compress(field, knee)
    diagonal = Roughness.about(seen, grid, 1.0).diagonal()
    return diagonal if knee is None else diagonal.mul_(compressed_slope(field, knee).square_())


def slopes(field: Tensor, grid: Grid) -> list[Tensor]:
    """How `field` [..., z, y, x] rises to the next cell, along each axis; 0 where there is none.

    By position in units of the box's shortest side.
    """
    found = []
    for axis, factor in zip(AXES, _factors(grid), strict=True):
        last = torch.zeros_like(field.narrow(axis, 0, 1))
        found.append(torch.cat([field.diff(dim=axis) * factor, last], axis))
    return found


def join_slopes(rises: list[Tensor], grid: Grid) -> Tensor:
    """The transpose of `slopes`."""
    total = torch.zeros_like(rises[0])
    for rise, axis, factor in zip(rises, AXES, _factors(grid), strict=True):
        inner = rise.narrow(axis, 0, rise.shape[axis] - 1) * factor
        total.narrow(axis, 0, rise.shape[axis] - 1).sub_(inner)
        total.narrow(axis, 1, rise.shape[axis] - 1).add_(inner)
    return total


def _factors(grid: Grid) -> list[float]:
    return [min(grid.extent) / spacing for spacing in grid.spacing]
