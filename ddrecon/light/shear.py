"""The mass that a beam passes on its way to each cell.

Times the scale of a `Coefficient` it is the optical depth in the tau of E2. It is found in three
steps on whole slices: shear the grid until the beam runs along an axis, sum along that axis, shear
back. What is interpolated is the field and its integral, never an exponential of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.interpolation import sample_slices
from ddrecon.numerics.slicing import Slicing, across
from ddrecon.numerics.third_order import ThirdOrder
from ddrecon.slabs.slab import Slab


def sum_mass_to_cells(
    field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float = 0.0
) -> tuple[Tensor, Tensor]:
    """The mass up to where a beam enters each cell's slice, and its path within a slice [u].

    The mass is the integral of `field` along the beam, from the box on. Slices are those across the
    axis along which the beam crosses most cells.

    `field`: [K, z, y, x]; outside the box it falls to zero within half a cell, which keeps the mass
    of the outer half cells. `direction`: [3], unit, array order, the way light travels. `bound`: 1
    over the most by which each of two corrections may change a mass, 0 for no limit.

    Along an axis of the grid the sum is exact. A slanted beam is also looked at on planes midway
    between slices, and its mass is carried back to cells to third order: the two corrections.
    Returns `[K, z, y, x]` and a scalar.
    """
    if is_fused_whole(grid, direction):
        from ddrecon.light.fused.beams import sum_mass

        return sum_mass(field, grid, direction, bound)
    sum_one: Callable[..., tuple[Tensor, Tensor]] = _sum_mass
    if isinstance(grid, Slab):
        from ddrecon.light import shear_slabs

        sum_one = shear_slabs.sum_mass
    if field.shape[0] == 1:
        return sum_one(field, grid, direction, bound)
    each = [recompute(sum_one, one, grid, direction, bound) for one in field.split(1)]
    return torch.cat([entered for entered, _ in each]), each[0][1]


def is_fused_whole(grid: Grid, *directions: Tensor) -> bool:
    """Whether fused kernels follow beams along `directions`; in slabs they do not."""
    return not isinstance(grid, Slab) and is_fused(*directions)


def _sum_mass(
    field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float
) -> tuple[Tensor, Tensor]:
    """What `sum_mass_to_cells` returns, of one field [1, z, y, x]."""
    slicing, slope, step = cross_grid(grid, direction)
    slices = slicing.lay(field)
    shear = Shear.of(slices.shape[0], slices.shape[2:], slope)
    on_slices, bends = shear.look(slices)
    third_order = ThirdOrder(0, 1, bound)
    passed = mass_passed(on_slices, bends, step, third_order)
    # Shear back, from rays to cells.
    return slicing.lift(shear.to_cells(passed, third_order)), step


def cross_grid(grid: Grid, direction: Tensor) -> tuple[Slicing, Tensor, Tensor]:
    """How a beam along `direction` goes through `grid`: in which slices, and from one to the next.

    There it goes a `step` [u] and drifts by `slope` [2], in rows and columns.
    """
    speed = direction / direction.new_tensor(grid.spacing)
    slicing = Slicing.of(speed.tolist())
    slope = (
        torch.stack([speed[other] for other in across(slicing.axis)]) / speed[slicing.axis].abs()
    )
    return slicing, slope, grid.spacing[slicing.axis] / direction[slicing.axis].abs()


def mass_passed(
    on_slices: Tensor,
    bends: Tensor,
    step: Tensor,
    third_order: ThirdOrder,
    before: Tensor | None = None,
) -> Tensor:
    """The mass [N, K, *lattice] on rays up to each slice, from what `Shear.look` has found.

    `before` [2, K, *lattice] are sums of both over what lies before the first slice.
    """
    # Trapezoids over half steps are more than those over whole ones by
    # (step / 2) sum over j < k of (rho_(j + 1/2) - (rho_j + rho_(j + 1)) / 2).
    bent = torch.cat([torch.zeros_like(on_slices[:1]), bends]).cumsum(0)
    # The mass of all slices passed: step sum over j < k of rho_j.
    passed = on_slices.cumsum(0) - on_slices
    if before is not None:
        passed, bent = passed + before[0], bent + before[1]
    return passed * step + third_order.bounded(bent * (0.5 * step))


@dataclass(frozen=True)
class Shear:
    """Rays along a beam, as many as a `lattice` has points, and where they meet slices of `size`.

    Ray r meets slice k at cell r - `first` + k `slope`, in rows as in columns; with this lattice
    there is a ray for every cell. Slices are counted from number `begin` on.
    """

    slope: Tensor
    size: tuple[int, int]
    lattice: tuple[int, int]
    first: tuple[int, int]
    begin: int = 0

    @staticmethod
    def of(slices: int, size: Sequence[int], slope: Tensor) -> Shear:
        """The rays that meet so many `slices` of `size` (height, width)."""
        height, width = size
        rows, columns = (math.floor(abs(s) * (slices - 1) + 1e-9) + 1 for s in slope.tolist())
        is_on = [s > 0 for s in slope.tolist()]
        return Shear(
            slope,
            (height, width),
            (height + rows, width + columns),
            (rows * is_on[0], columns * is_on[1]),
        )

    def look(self, slices: Tensor) -> tuple[Tensor, Tensor]:
        """The field on rays: rho_k on `slices` [N, K, H, W], and how much it bends between two.

        That is rho_(k + 1/2), midway, where the field is the mean of both slices, less the mean of
        rho_k and rho_(k + 1).
        """
        on_slices = self.to_rays(slices, 0.0)
        midway = self.to_rays(0.5 * (slices[1:] + slices[:-1]), 0.5)
        return on_slices, midway - 0.5 * (on_slices[1:] + on_slices[:-1])

    def to_rays(self, slices: Tensor, shift: float) -> Tensor:
        """`slices` [N, K, H, W], the first of which is number `shift`, where rays meet them.

        They fall to zero one cell beyond their outermost centers.
        """
        # Around each slice lies a ring of zeros.
        points = self._points(slices, shift, self.lattice, self.size, 1, ring=1)
        return sample_slices(pad(slices, (1, 1, 1, 1)), points).unflatten(-1, self.lattice)

    def to_cells(self, values: Tensor, third_order: ThirdOrder | None = None) -> Tensor:
        """`values` [N, K, *lattice] on the rays, at the centers of the slices' cells."""
        points = self._points(values, 0.0, self.size, self.lattice, -1)
        return sample_slices(values, points, third_order).unflatten(-1, self.size)

    def _points(
        self,
        like: Tensor,
        shift: float,
        points: tuple[int, int],
        cells: tuple[int, int],
        sign: int,
        ring: int = 0,
    ) -> Tensor:
        """Where `points` fall among `cells` and those of a `ring` around, [N, count, 2] in [-1, 1].

        `sign` is 1 for rays among cells, -1 for cells among rays.
        """
        index = torch.arange(like.shape[0], dtype=like.dtype, device=like.device) + (
            self.begin + shift
        )
        lines = []
        for slope, first, count, size in zip(self.slope, self.first, points, cells, strict=True):
            drift = sign * (index * slope - first)
            position = drift[:, None] + torch.arange(count, dtype=like.dtype, device=like.device)
            lines.append((2 * position + 1 - size) / (size + 2 * ring))
        rows, columns = lines
        pairs = torch.broadcast_tensors(columns[:, None], rows[:, :, None])
        return torch.stack(pairs, -1).flatten(1, 2)
