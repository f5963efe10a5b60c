"""The mass that a beam passes on its way to each cell.

Times the scale of a `Coefficient` it is the optical depth in the tau of E2.2. It is found in three
steps on whole slices: shear the grid until the beam runs along an axis, sum along that axis, shear
back. What is interpolated is the field and its integral, never an exponential of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.numerics.autodiff import is_fused
from ddrecon.numerics.interpolation import ThirdOrder, nearly, sample_slices
from ddrecon.numerics.layout import Slicing, across, unroll_along
from ddrecon.numerics.remember import constant, remember

LEAST_SLOPE = 1e-6
"""A smaller slope counts as this: such beams enter through no side of a grid."""


def sum_masses(
    field: Tensor, grid: Grid, directions: Tensor, bound: Tensor | float
) -> tuple[Tensor, Tensor]:
    """The mass up to where beams enter each cell's slice, and their paths within a slice [u].

    The mass is the integral of `field` along the beam, from the box on. Slices are those across the
    axis along which the beam crosses most cells.

    `field`: [K, z, y, x]; up to the faces of the box it is as in the outermost cells. `directions`:
    [L, 3], unit, array order, the way light travels. `bound`: 1 over the most by which each of two
    corrections may change a mass, 0 for no limit.

    Along an axis of the grid the sum is exact. The two corrections: a slanted beam is also sampled
    midway between slices, and its mass is carried back to cells to third order. Slices' sides let
    it in as faces do (E5.9). Returns `[L, K, z, y, x]` and `[L]`, to be recomputed.
    """
    if grid.periodic:
        beams = [_sum_period(field, grid, direction, bound) for direction in directions.split(1)]
        return torch.cat([mass for mass, _ in beams]), torch.cat([step for _, step in beams])
    bound, shears = torch.as_tensor(bound).to(field), cross_grid(grid, directions)
    steps = torch.stack([shear.step for shear in shears])
    if is_fused(directions):
        from ddrecon.light.fused import shear as fused

        return fused.sum_masses(field, shears, bound), steps
    return torch.stack([_sum_mass(field, shear, bound) for shear in shears]), steps


def _sum_period(
    field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float
) -> tuple[Tensor, Tensor]:
    """What `sum_masses` returns of one `direction` [1, 3], in a `grid` that repeats."""
    period = unroll_along(grid, direction[0])
    mass, step = sum_masses(period.extend(field), period.wide, direction, bound)
    return period.crop(mass), step


def _sum_mass(field: Tensor, shear: Shear, bound: Tensor) -> Tensor:
    """The mass [K, z, y, x] of one beam."""
    slices = shear.slicing.lay(field)
    on_slices = shear.to_rays(slices, 0.0)
    inside = shear.inside(on_slices)
    within, missing = on_slices * inside, on_slices * (1 - inside)
    # Trapezoids over half steps are more than those over whole ones by (step / 2) times the sum
    # over j < k of how much the field bends: rho_(j + 1/2), where it is the mean of both slices,
    # less (rho_j + rho_(j + 1)) / 2.
    midway = shear.to_rays(0.5 * (slices[1:] + slices[:-1]), 0.5)
    bends = (midway - 0.5 * (on_slices[1:] + on_slices[:-1])) * inside[:-1]
    curved = torch.cat([torch.zeros_like(within[:1]), bends]).cumsum(0)
    # The mass of all slices passed: step sum over j < k of rho_j.
    passed = within.cumsum(0) - within
    limit = ThirdOrder(0, 1, bound * (1 - 0.5 * (1 - inside)))
    mass = passed * shear.step + limit.bounded((0.5 * curved - missing) * shear.step)
    return shear.slicing.lift(shear.to_cells(mass, ThirdOrder(0, mass.shape[1], bound)))


@remember
def cross_grid(grid: Grid, directions: Tensor) -> tuple[Shear, ...]:
    """How beams along `directions` [L, 3] go through `grid`."""
    return tuple(Shear.along(grid, direction) for direction in directions)


@dataclass(frozen=True)
class Shear:
    """Rays along a beam through `grid`: where they meet slices of `size`, by a `lattice` of them.

    From one slice to the next they drift by `slope` [2], in rows and columns, and go a `step` [u]:
    `numbers` [3]. Ray r meets slice k at cell r - `first` + k `slope`; with this lattice there is a
    ray for every cell.
    """

    grid: Grid
    slicing: Slicing
    numbers: Tensor
    size: tuple[int, ...]
    lattice: tuple[int, ...]
    first: tuple[int, ...]

    @staticmethod
    def along(grid: Grid, direction: Tensor) -> Shear:
        """The rays along `direction` [3] that meet slices of `grid`, or come near."""
        slicing, slope, step = slice_along(grid, direction)
        size = tuple(grid.shape[axis] for axis in across(slicing.axis))
        count, slopes = grid.shape[slicing.axis], slope.tolist()
        drifts = [math.floor(abs(s) * (count - 1) + 1e-9) + 1 for s in slopes]
        lattice = tuple(n + drift + 3 for n, drift in zip(size, drifts, strict=True))
        first = tuple(1 + drift * (s > 0) for drift, s in zip(drifts, slopes, strict=True))
        return Shear(grid, slicing, torch.cat([slope, step[None]]), size, lattice, first)

    @property
    def slope(self) -> Tensor:
        """By rows and by columns, [2]."""
        return self.numbers[:2]

    @property
    def step(self) -> Tensor:
        """The path from one slice to the next [u], a scalar."""
        return self.numbers[2]

    def inside(self, on_slices: Tensor) -> Tensor:
        """Which part of a step around each of N slices rays are in the box for, 0 to 1.

        Returns `[N, 1, *lattice]`.
        """
        # On which slice a ray enters through a side of the box; through an edge by rows.
        steep = torch.where(self.slope.abs() > LEAST_SLOPE, self.slope, LEAST_SLOPE)
        rows, columns = (
            (cells * (s < 0) - 0.5 + first - _count(rays, steep)) / s
            for s, cells, first, rays in zip(
                steep, self.size, self.first, self.lattice, strict=True
            )
        )
        rows, columns = torch.broadcast_tensors(rows[:, None], columns)
        is_by_row = columns - rows < nearly(rows, sum(self.lattice))
        entries = torch.where(is_by_row, rows, columns)

        entered = _count(len(on_slices), on_slices)[:, None, None] + 0.5 - entries
        near = nearly(entered, len(on_slices) + 1)
        is_between = (entered > -near) & (entered < 1 + near)
        return torch.where(is_between, entered, entered.detach().clamp(0, 1))[:, None]

    def to_rays(self, slices: Tensor, shift: float) -> Tensor:
        """`slices` [N, K, H, W], the first of which is number `shift`, where rays meet them.

        On a cell's center slopes are those of cells among rays, which move the other way: the sides
        are swapped.
        """
        points = self._points(_count(len(slices), slices) + shift, self.lattice, self.size, 1)
        return sample_slices(slices.flip(2, 3), -points).unflatten(-1, self.lattice)

    def to_cells(self, values: Tensor, third_order: ThirdOrder | None = None) -> Tensor:
        """`values` [N, K, *lattice] on the rays, at the centers of the slices' cells."""
        points = self._points(_count(len(values), values), self.size, self.lattice, -1)
        return sample_slices(values, points, third_order).unflatten(-1, self.size)

    def _points(
        self, slices: Tensor, points: tuple[int, ...], cells: tuple[int, ...], sign: int
    ) -> Tensor:
        """Where `points` fall among `cells` on `slices` [N], [N, count, 2] in [-1, 1].

        `sign` is 1 for rays among cells, -1 for cells among rays.
        """
        row, column = (
            (2 * ((sign * (slices * slope - first))[:, None] + _count(count, slices)) + 1 - size)
            / size
            for slope, first, count, size in zip(self.slope, self.first, points, cells, strict=True)
        )
        pairs = torch.broadcast_tensors(column[:, None], row[:, :, None])
        return torch.stack(pairs, -1).flatten(1, 2)


def slice_along(grid: Grid, direction: Tensor) -> tuple[Slicing, Tensor, Tensor]:
    """The slices in which a beam along `direction` [3] goes through `grid`, its slope and step.

    From one slice to the next it drifts by `slope` [2] rows and columns, and goes a `step` [u].
    """
    speed = direction / constant(grid.spacing, direction)
    slicing = Slicing.of(speed.tolist())
    row, column = across(slicing.axis)
    slope = torch.stack([speed[row], speed[column]]) / speed[slicing.axis].abs()
    return slicing, slope, grid.spacing[slicing.axis] / direction[slicing.axis].abs()


def _count(size: int, like: Tensor) -> Tensor:
    return torch.arange(size, dtype=like.dtype, device=like.device)
