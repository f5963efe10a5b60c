"""A parameter: a value with its bounds, its penalty and its resolution."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

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
GLOW, HAZE = 0.05, 0.1
"""The knee of what glows beside a density, in brightnesses of the pictures for each optical depth,
and the depth that empty space has there (E11.3). Measured on balls and a fire: at a knee of 0.15
thin smoke glows evenly in place of smoke that is lit.
"""
Knee = float | Tensor | None
AXES = (-3, -2, -1)


def total_variation(field: Tensor, grid: Grid, knee: Knee = None) -> Tensor:
    """The mean length of the gradient of `field` [..., z, y, x] over the cells of `grid`.

    The gradient is by position in units of the box's shortest side.

    Isotropic total variation (Rudin, Osher, Fatemi 1992, doi:10.1016/0167-2789(92)90242-F), the
    same at every resolution and world scale, and rounded off at zero so that its derivative is
    finite in flat regions. With a `knee` > 0, in the unit of `field` >= 0, it is that of
    log(1 + field / knee) / 3 (E11.3).
    """
    return (_find_length(field, grid, knee) - ROUNDING).mean()


def face_stiffness(
    field: Tensor, grid: Grid, knee: Knee = None, weight: float = 1.0
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


def _find_length(field: Tensor, grid: Grid, knee: Knee) -> Tensor:
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

    An emission beside a density that is sought, its `medium`, is smooth for each optical depth:
    what has no mass hardly glows. `is_per_depth` says that the search moves it so as well.
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
        self.medium: Parameter | None = None
        self.is_per_depth = False

    def glow_in(self, medium: Parameter) -> None:
        """Has it be smooth for each optical depth of `medium`."""
        self.medium, self.knee = medium, GLOW

    def depth(self, density: Tensor) -> Tensor:
        """Optical depths [z, y, x] across the box, of a `density` of its medium, and haze."""
        assert self.medium is not None
        return density / self.medium.unit + HAZE

    def knee_at(self, density: Tensor | None) -> Knee:
        """The knee of what the search moves, where its medium has a `density`."""
        if density is None or self.is_per_depth:
            return self.knee
        return GLOW * self.depth(density)

    @property
    def coordinate(self) -> Tensor:
        """What the search moves: its value, or that for each optical depth."""
        value = self.value.detach()
        if self.medium is not None and self.is_per_depth:
            value = value / self.depth(self.medium.value.detach())
        return value

    def penalty(self) -> Tensor:
        """What its total variation adds to the loss, a function of its value and its medium's.

        It is relative to the mean square of the targets: brighter light or a wider frame change
        nothing. See `ParameterSettings` for its weight.
        """
        source = self.value / self.unit
        if self.medium is not None:
            source = source / self.depth(self.medium.value)
        return self.tv * total_variation(source, self.grid, self.knee)

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


def by_coordinates(
    parameters: Iterable[Parameter], bars: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The derivatives by what the search moves, of `bars`, those by values of `parameters`."""
    turned = dict(bars)
    for p in parameters:
        if p.medium is not None and p.is_per_depth and p.name in bars:
            depth = p.depth(p.medium.value.detach())
            turned[p.name] = bars[p.name] * depth
            # What is denser also glows more.
            more = bars[p.name] * p.coordinate / p.medium.unit
            turned[p.medium.name] = turned[p.medium.name] + more.view(-1, *depth.shape).sum(0)
    return turned
