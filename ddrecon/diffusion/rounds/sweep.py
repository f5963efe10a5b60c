"""One sweep: radiance along every direction of a quadrature, of which only moments are kept (E12).

Directions are gone through one at a time, and computed again one at a time in the backward pass:
memory does not grow with their number.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import Direction, radiance_along
from ddrecon.engine import current_engine
from ddrecon.light.moments import Moments, Vector
from ddrecon.medium.coefficients import Coefficient, Medium
from ddrecon.numerics.autodiff import is_forward
from ddrecon.numerics.quadrature import sphere_quadrature


class Parts(NamedTuple):
    """All tensors that a sweep depends on, as autograd must be given them: one by one.

    `scattering_field` is None where the field is that of extinction; `inflow` is None for no light
    from outside; `z`, `y`, `x` are the flux of what scatters, None where it has none.
    """

    extinction_scale: Tensor
    extinction_field: Tensor
    scattering_scale: Tensor
    scattering_field: Tensor | None
    forward_fraction: Tensor
    inflow: Tensor | None
    mean: Tensor
    z: Tensor | None = None
    y: Tensor | None = None
    x: Tensor | None = None

    @staticmethod
    def of(medium: Medium, light: Moments, inflow: Tensor | None) -> Parts:
        """The parts of `medium` and of the `light` that scatters in it."""
        shares_field = medium.scattering.field is medium.extinction.field
        return Parts(
            medium.extinction.scale,
            medium.extinction.field,
            medium.scattering.scale,
            None if shares_field else medium.scattering.field,
            medium.forward_fraction,
            inflow,
            light.mean,
            *(light.flux or ()),
        )

    @property
    def flux(self) -> Vector | None:
        """The flux of the light that scatters."""
        if self.z is None or self.y is None or self.x is None:
            return None
        return self.z, self.y, self.x

    def radiance(self, medium: Medium, direction: Direction) -> Tensor:
        """I along `direction` (E11), these parts standing for those of `medium`."""
        field = self.extinction_field if self.scattering_field is None else self.scattering_field
        medium = replace(
            medium,
            extinction=Coefficient(self.extinction_scale, self.extinction_field),
            scattering=Coefficient(self.scattering_scale, field),
            forward_fraction=self.forward_fraction,
        )
        return radiance_along(medium, Moments(self.mean, self.flux), self.inflow, direction)


def sweep(medium: Medium, light: Moments, inflow: Tensor | None, directions: int) -> Moments:
    """L0' and, where `light` has flux, L1' of the radiance that `light` scatters (E11, E12).

    `light` and `inflow`, light from outside, are those of `radiance_along`; `directions`: how many
    the quadrature has.
    """
    parts = Parts.of(medium, light, inflow)
    if is_forward():
        mean, *flux = _sum_over_directions(medium, directions, parts)
    elif current_engine() == "warp":
        from ddrecon.diffusion.rounds.fused.sweep import sweep_fused

        weighted = _directions(directions, 1 if light.flux is None else 4)
        mean, *flux = sweep_fused(medium, light, inflow, weighted)
    else:
        mean, *flux = _Sweep.apply(medium, directions, *parts)
    if not flux:
        return Moments(mean)
    z, y, x = flux
    return Moments(mean, (z, y, x))


class _Sweep(torch.autograd.Function):
    """The moments of all directions; the backward pass computes each direction's radiance again."""

    @staticmethod
    def forward(ctx: Any, medium: Medium, directions: int, *parts: Any) -> tuple[Tensor, ...]:
        ctx.medium, ctx.directions = medium, directions
        ctx.save_for_backward(*parts)
        return _sum_over_directions(medium, directions, Parts(*parts))

    @staticmethod
    def backward(ctx: Any, *moment_bars: Tensor) -> tuple[Tensor | None, ...]:
        leaves: list[Any] = [
            part if part is None else part.detach().requires_grad_(need)
            for part, need in zip(ctx.saved_tensors, ctx.needs_input_grad[2:], strict=True)
        ]
        varied = [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]
        totals = [torch.zeros_like(leaf) for leaf in varied]
        for direction, weights in _directions(ctx.directions, len(moment_bars)):
            # I along this direction once more (E11), with the graph of this direction alone
            with torch.enable_grad():
                radiance = Parts(*leaves).radiance(ctx.medium, direction)
            # E12 transposed: I_bar is the sum over moments of weight times moment_bar
            radiance_bar = torch.stack(
                [weight * bar for weight, bar in zip(weights, moment_bars, strict=True)]
            ).sum(0)
            # E11 transposed, by autograd: what each part receives from this direction
            bars = torch.autograd.grad(radiance, varied, radiance_bar, allow_unused=True)
            for total, bar in zip(totals, bars, strict=True):
                if bar is not None:
                    total += bar
        remaining = iter(totals)
        part_bars = (
            None if leaf is None or not leaf.requires_grad else next(remaining) for leaf in leaves
        )
        return None, None, *part_bars


def _sum_over_directions(medium: Medium, directions: int, parts: Parts) -> tuple[Tensor, ...]:
    """The mean of I and, where `parts` have flux, 3 times the mean of I w along z, y, x (E12)."""
    totals: list[Tensor] = []
    for direction, weights in _directions(directions, 1 if parts.flux is None else 4):
        radiance = parts.radiance(medium, direction)
        totals = totals or [torch.zeros_like(radiance)] * len(weights)
        totals = [
            torch.add(total, radiance, alpha=weight)
            for total, weight in zip(totals, weights, strict=True)
        ]
    return tuple(totals)


@functools.cache
def _directions(count: int, moments: int) -> tuple[tuple[Direction, tuple[float, ...]], ...]:
    """Each direction w (array order) and the weights of its I in the moments of E12.

    They are W, 3 W w_z, 3 W w_y and 3 W w_x, W being the quadrature's weight, or the first
    `moments` of them.
    """
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), count)
    return tuple(
        ((z, y, x), (w, 3 * w * z, 3 * w * y, 3 * w * x)[:moments])
        for (z, y, x), w in zip(points.tolist(), weights.tolist(), strict=True)
    )
