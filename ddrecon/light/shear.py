"""The mass that a beam passes on its way to each cell.

Times the scale of a `Coefficient` it is the optical depth in the tau of E2.2. It is found in three
steps on whole slices: shear the grid until the beam runs along an axis, sum along that axis, shear
back. What is interpolated is the field and its integral, never an exponential of them.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.constants import constant
from ddrecon.numerics.interpolation import sample_slices
from ddrecon.numerics.periods import unroll_along
from ddrecon.numerics.slicing import Slicing, across
from ddrecon.numerics.third_order import ThirdOrder, nearly

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

    Along an axis of the grid the sum is exact. A slanted beam is also looked at on planes midway
    between slices, and its mass is carried back to cells to third order: the two corrections.
    Slices' sides let it in as faces do (E5.9).
    Returns `[L, K, z, y, x]` and `[L]`, to be recomputed.
    """
    if grid.periodic:
        found = list[tuple[Tensor, Tensor]]()
        for one in directions.split(1):
            period = unroll_along(grid, one[0])
            mass, path = sum_masses(period.extend(field), period.wide, one, bound)
            found.append((period.crop(mass), path))
        return torch.cat([mass for mass, _ in found]), torch.cat([path for _, path in found])
    if is_fused(directions):
        from ddrecon.light.fused import shear

        return shear.sum_masses(field, grid, directions, bound)
    masses, steps = list[Tensor](), list[Tensor]()
    for direction in directions:
        if len(field) == 1:
            each = [_sum_mass(field, grid, direction, bound)]
        else:
            each = [recompute(_sum_mass, one, grid, direction, bound) for one in field.split(1)]
        masses.append(torch.cat([entered for entered, _ in each]))
        steps.append(each[0][1])
    return torch.stack(masses), torch.stack(steps)


def _sum_mass(
    field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float
) -> tuple[Tensor, Tensor]:
    """What `sum_masses` returns, of one beam and one field [1, z, y, x]."""
    slicing, slope, step = cross_grid(grid, direction)
    slices = slicing.lay(field)
    shear = Shear.of(len(slices), slices.shape[2:], slope)
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
    mass = passed * step + limit.bounded((0.5 * curved - missing) * step)
    return slicing.lift(shear.to_cells(mass, ThirdOrder(0, 1, bound))), step


def cross_grid(grid: Grid, direction: Tensor) -> tuple[Slicing, Tensor, Tensor]:
    """How a beam along `direction` goes through `grid`: in which slices, and from one to the next.

    There it goes a `step` [u] and drifts by `slope` [2], in rows and columns.
    """
    speed = direction / constant(grid.spacing, direction)
    slicing = Slicing.of(speed.tolist())
    slope = (
        torch.stack([speed[other] for other in across(slicing.axis)]) / speed[slicing.axis].abs()
    )
    return slicing, slope, grid.spacing[slicing.axis] / direction[slicing.axis].abs()


@dataclass(frozen=True)
class Shear:
    """Rays along a beam, as many as a `lattice` has points, and where they meet slices of `size`.

    Ray r meets slice k at cell r - `first` + k `slope`, in rows as in columns; with this lattice
    there is a ray for every cell. The `faces` by which light enters lie so far from cell 0.
    """

    slope: Tensor
    size: tuple[int, ...]
    lattice: tuple[int, ...]
    first: tuple[int, ...]
    faces: tuple[float, ...]

    @staticmethod
    def of(slices: int, size: Sequence[int], slope: Tensor) -> Shear:
        """The rays that meet so many `slices` of `size` (height, width), or come near."""
        slopes = slope.tolist()
        more = [math.floor(abs(s) * (slices - 1) + 1e-9) + 1 for s in slopes]
        lattice = tuple(n + own + 3 for n, own in zip(size, more, strict=True))
        first = tuple(1 + own * (s > 0) for own, s in zip(more, slopes, strict=True))
        faces = (-0.5 + n * (s < -LEAST_SLOPE) for n, s in zip(size, slopes, strict=True))
        return Shear(slope, tuple(size), lattice, first, tuple(faces))

    @functools.cached_property
    def entries(self) -> Tensor:
        """On which slice rays enter through a side of the box, [*lattice]."""
        steep = torch.where(self.slope.abs() > LEAST_SLOPE, self.slope, LEAST_SLOPE)
        rows, columns = (
            (face + first - torch.arange(count, dtype=s.dtype, device=s.device)) / s
            for s, count, first, face in zip(
                steep, self.lattice, self.first, self.faces, strict=True
            )
        )
        rows, columns = torch.broadcast_tensors(rows[:, None], columns)
        # Through an edge by rows.
        return torch.where(columns - rows < nearly(rows, sum(self.lattice)), rows, columns)

    def inside(self, like: Tensor) -> Tensor:
        """Which part of a step around slices rays are in the box for, 0 to 1 [N, 1, *lattice].

        There are as many slices as `like` has.
        """
        entered = self._numbers(like, 0.5)[:, None, None] - self.entries
        near = nearly(entered, len(like) + 1)
        is_between = (entered > -near) & (entered < 1 + near)
        return torch.where(is_between, entered, entered.detach().clamp(0, 1))[:, None]

    def to_rays(self, slices: Tensor, shift: float) -> Tensor:
        """`slices` [N, K, H, W], the first of which is number `shift`, where rays meet them.

        Beyond them they are as their outermost cells. On a cell's center slopes are those of cells
        among rays, which move the other way: the sides are swapped.
        """
        points = self._points(slices, shift, self.lattice, self.size, 1)
        return sample_slices(slices.flip(2, 3), -points).unflatten(-1, self.lattice)

    def to_cells(self, values: Tensor, third_order: ThirdOrder | None = None) -> Tensor:
        """`values` [N, K, *lattice] on the rays, at the centers of the slices' cells."""
        points = self._points(values, 0.0, self.size, self.lattice, -1)
        return sample_slices(values, points, third_order).unflatten(-1, self.size)

    def _numbers(self, like: Tensor, shift: float) -> Tensor:
        count = torch.arange(like.shape[0], dtype=like.dtype, device=like.device)
        return count + shift

    def _points(
        self,
        like: Tensor,
        shift: float,
        points: tuple[int, ...],
        cells: tuple[int, ...],
        sign: int,
    ) -> Tensor:
        """Where `points` fall among `cells`, [N, count, 2] in [-1, 1].

        `sign` is 1 for rays among cells, -1 for cells among rays.
        """
        index, lines = self._numbers(like, shift), []
        for slope, first, count, size in zip(self.slope, self.first, points, cells, strict=True):
            drift = sign * (index * slope - first)
            position = drift[:, None] + torch.arange(count, dtype=like.dtype, device=like.device)
            lines.append((2 * position + 1 - size) / size)
        row, column = lines
        pairs = torch.broadcast_tensors(column[:, None], row[:, :, None])
        return torch.stack(pairs, -1).flatten(1, 2)
