"""A parameter: a value with its bounds, its penalty and its resolution."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import resample
from ddrecon.settings import ParameterSettings
from ddrecon.variables.kinds import kind_of

ROUNDING = 1e-2
"""Gradients below this, in units of one over the box's shortest side, are penalized quadratically
rather than as total variation.
"""
KNEE = 1.2
"""Total variation is that of densities far below it, and of the logarithm of those above (E11.3).

It is in optical depths across the box's shortest side, whatever the unit of density is.
"""
AXES = (-3, -2, -1)


def total_variation(field: Tensor, grid: Grid, knee: float | None = None) -> Tensor:
    """The mean length of the gradient of `field` [..., z, y, x] over the cells of `grid`.

    The gradient is by position in units of the box's shortest side.

    Isotropic total variation (Rudin, Osher, Fatemi 1992, doi:10.1016/0167-2789(92)90242-F), the
    same at every resolution and world scale, and rounded off at zero so that its derivative is
    finite in flat regions. With a `knee` > 0, in the unit of `field` >= 0, it is that of
    log(1 + field / knee) / 3 (E11.3).
    """
    return (_find_length(field, grid, knee) - ROUNDING).mean()


def face_stiffness(
    field: Tensor, grid: Grid, knee: float | None = None, weight: float = 1.0
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor | None]:
    """R (E11.2) of `total_variation` at `field` [..., z, y, x], as D^T V D between S on both sides.

    It returns `weight` D^T V D by the stiffness of each face above a cell along z, y, x, shaped as
    `field`, and S, the slope of the compression: None without a `knee`.
    """
    inverse, faces = _find_length(field, grid, knee).reciprocal_(), list[Tensor]()
    for axis, spacing in zip(AXES, grid.spacing, strict=True):
        face = inverse * (weight / field.numel() * (min(grid.extent) / spacing) ** 2)
        count = field.shape[axis]
        if count == 1 or axis % 3 not in grid.periodic:
            face.narrow(axis, count - 1, 1).zero_()
        faces.append(face)
    z, y, x = faces
    return (z, y, x), None if knee is None else (3 * (field + knee)).reciprocal_()


def _find_length(field: Tensor, grid: Grid, knee: float | None) -> Tensor:
    """The length of the gradient of `field`, compressed where there is a `knee`, rounded at 0."""
    seen, times = (field, 1.0) if knee is None else (torch.log1p(field / knee), 1 / 3)
    square = torch.full_like(field, ROUNDING**2)
    for axis, spacing in zip(AXES, grid.spacing, strict=True):
        scale = (times * min(grid.extent) / spacing) ** 2
        square = torch.add(square, _rise_to_next(seen, axis, grid).square(), alpha=scale)
    return square.sqrt()


def _rise_to_next(field: Tensor, axis: int, grid: Grid) -> Tensor:
    """The rise of `field` [..., z, y, x] to the next cell along `axis`, -3 to -1.

    After the last cell of a period comes its first; in a box the last has no next, and 0.
    """
    if axis % 3 in grid.periodic:
        return field.roll(-1, axis) - field
    return pad(field.diff(dim=axis), [0, 0] * (-1 - axis) + [0, 1])


class Parameter:
    """The value of one variable, its bounds, and how much its changes count.

    A field is `[..., z, y, x]` on `grid` and follows its refinement; anything else is the same at
    every resolution. It stays 0 where its `support` [z, y, x] is 0; None is nowhere. `view` is the
    name of the view that it belongs to, None for what all views see. Its total variation is that of
    it in the `unit` of `unit_of`.
    """

    def __init__(
        self,
        name: str,
        settings: ParameterSettings,
        value: Tensor,
        grid: Grid,
        unit: float = 1.0,
    ):
        kind = kind_of(name)
        self.name, self.grid = name, grid
        self.low = kind.low if settings.min is None else settings.min
        self.high = kind.high if settings.max is None else settings.max
        owner, _, self.key = name.rpartition(".")
        self.view = owner.removeprefix("views.") if owner.startswith("views.") else None
        self.is_direction = kind.is_direction
        self.is_field = kind.is_cellwise and tuple(value.shape[-3:]) == grid.shape
        weight = kind.tv if settings.tv is None else settings.tv
        self.tv = weight if self.is_field else 0.0
        self.unit, self.knee = unit, KNEE if kind.is_compressed else None
        self.start, self.value = value.detach(), value.clone().requires_grad_()
        self.support: Tensor | None = None

    def penalty(self) -> tuple[Tensor, Tensor] | None:
        """What its total variation adds to the loss, and its derivative; None without.

        It is relative to the mean square of the targets: brighter light or a wider frame change
        nothing. See `ParameterSettings` for its weight.
        """
        if not self.tv:
            return None
        total = self.tv * total_variation(self.value / self.unit, self.grid, self.knee)
        return total.detach(), torch.autograd.grad(total, self.value)[0]

    def project(self, value: Tensor) -> Tensor:
        """`value` within bounds and support; a direction as long as it is now."""
        if self.is_direction:
            value = value * (self.value.detach().norm() / value.norm())
        value = value.clamp(self.low, self.high)
        return value if self.support is None else value * self.support

    def free(self, value: Tensor, gradient: Tensor) -> Tensor:
        """1 where an entry of `value` may move against its `gradient`, else 0."""
        is_free = (value > self.low) | (gradient <= 0)
        if self.high < math.inf:
            is_free &= (value < self.high) | (gradient >= 0)
        return is_free.to(value) if self.support is None else is_free * self.support

    def keep_start(self, fraction: float) -> None:
        """Moves a field back towards its start, by a `fraction` of their difference."""
        value = self.value.detach().lerp(resample(self.start, self.grid), fraction)
        self.value = (value if self.support is None else value * self.support).requires_grad_()

    def value_on(self, grid: Grid) -> Tensor:
        """A copy of its value, on `grid` where it is a field."""
        value = self.value.detach()
        return (resample(value, grid) if self.is_field else value).clone()

    def carry(self, vector: Tensor, is_slope: bool) -> Tensor:
        """A move of its value, or a derivative, carried from another grid to its own."""
        carried = resample(vector, self.grid) if self.is_field else vector
        return carried * (vector.numel() / carried.numel()) if is_slope else carried

    def refine(self, grid: Grid) -> None:
        """Carries a field to `grid`.

        Interpolation blurs, so finer cells also get what their means lack of the old value.
        """
        old, old_grid, self.grid = self.value.detach(), self.grid, grid
        if self.is_field:
            value = self.value_on(grid)
            if grid.cells > old_grid.cells:
                value += resample(old - resample(value, old_grid), grid)
            self.value = value.clamp_(self.low, self.high).requires_grad_()

    def restrict(self, support: Tensor) -> None:
        """Empties it outside of `support` [z, y, x], where it stays 0 from now on."""
        self.support = support.to(self.value.dtype)
        self.value = (self.value.detach() * self.support).requires_grad_()
