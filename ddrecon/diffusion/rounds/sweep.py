"""One sweep: radiance along every direction of a quadrature, of which only the moments are kept
(E12).

Directions are gone through one at a time, and made again one at a time in the backward pass: memory
does not grow with their number.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import Direction, radiance_along
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Coefficient, Medium
from ddrecon.numerics.autodiff import is_forward
from ddrecon.numerics.quadrature import sphere_quadrature

FLUX = 7
"""Where the flux of what scatters begins in the parts of a sweep."""


def sweep(medium: Medium, light: Moments, inflow: Tensor | None, directions: int) -> Moments:
    """Mean and, where `light` has flux, flux of the radiance that `light` scatters and of `inflow`
    (see `radiance_along`).
    """
    shares_field = medium.scattering.field is medium.extinction.field
    parts = (
        *(
            medium.extinction.scale,
            medium.extinction.field,
            medium.scattering.scale,
            None if shares_field else medium.scattering.field,
        ),
        *(medium.forward_fraction, inflow, light.mean, *(light.flux or ())),
    )
    mean, *flux = (
        _sum_over_directions(medium, directions, *parts)
        if is_forward()
        else _Sweep.apply(medium, directions, *parts)
    )
    if not flux:
        return Moments(mean)
    z, y, x = flux
    return Moments(mean, (z, y, x))


class _Sweep(torch.autograd.Function):
    """The moments of all directions, whose backward pass makes each direction's radiance again
    before it is done with it.
    """

    @staticmethod
    def forward(ctx: Any, medium: Medium, directions: int, *parts: Any) -> tuple[Tensor, ...]:
        ctx.medium, ctx.directions = medium, directions
        ctx.save_for_backward(*parts)
        return _sum_over_directions(medium, directions, *parts)

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        leaves = [
            part if part is None else part.detach().requires_grad_(need)
            for part, need in zip(ctx.saved_tensors, ctx.needs_input_grad[2:], strict=True)
        ]
        varied = [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]
        totals = [torch.zeros_like(leaf) for leaf in varied]
        for direction, weights in _directions(ctx.directions, len(bars)):
            with torch.enable_grad():
                radiance = _radiance(ctx.medium, direction, *leaves)
            bar = torch.stack(
                [weight * bar for weight, bar in zip(weights, bars, strict=True)]
            ).sum(0)
            for total, part in zip(
                totals, torch.autograd.grad(radiance, varied, bar, allow_unused=True), strict=True
            ):
                if part is not None:
                    total += part
        found = iter(totals)
        return (
            None,
            None,
            *(None if leaf is None or not leaf.requires_grad else next(found) for leaf in leaves),
        )


def _sum_over_directions(medium: Medium, directions: int, *parts: Any) -> tuple[Tensor, ...]:
    """The mean of I and, where `parts` have flux, 3 times the mean of I w along z, y, x."""
    totals: list[Tensor] = []
    for direction, weights in _directions(directions, 4 if len(parts) > FLUX else 1):
        radiance = _radiance(medium, direction, *parts)
        totals = totals or [torch.zeros_like(radiance)] * len(weights)
        totals = [
            torch.add(total, radiance, alpha=weight)
            for total, weight in zip(totals, weights, strict=True)
        ]
    return tuple(totals)


def _radiance(medium: Medium, direction: Direction, *parts: Any) -> Tensor:
    """I along `direction`, of a medium and light put together from `parts`."""
    scale, field, scattering_scale, scattering_field, forward_fraction, inflow, mean, *flux = parts
    extinction = Coefficient(scale, field)
    scattering = Coefficient(
        scattering_scale, field if scattering_field is None else scattering_field
    )
    medium = replace(
        medium, extinction=extinction, scattering=scattering, forward_fraction=forward_fraction
    )
    return radiance_along(
        medium, Moments(mean, (flux[0], flux[1], flux[2]) if flux else None), inflow, direction
    )


def _directions(count: int, moments: int) -> list[tuple[Direction, tuple[float, ...]]]:
    """Each direction (array order) with its weights in the first `moments` of: mean, flux along z,
    y, x.
    """
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), count)
    return [
        ((z, y, x), (w, 3 * w * z, 3 * w * y, 3 * w * x)[:moments])
        for (z, y, x), w in zip(points.tolist(), weights.tolist(), strict=True)
    ]
