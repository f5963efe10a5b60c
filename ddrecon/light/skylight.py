"""Light of skies not yet scattered: a march for each direction, one at a time.

Only sums over directions are kept, so memory does not grow with their number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.light.beam import attenuate
from ddrecon.light.moments import Moments, Vector
from ddrecon.light.sky import Sky
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import is_varied, recompute
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature


def ambient_sky(radiance: Tensor) -> Sky:
    """Ambient light of `radiance` [C, 1, 1, 1], as light from the directions of a quadrature."""
    directions, weights = sphere_quadrature(radiance)
    irradiance = 4 * math.pi * weights[:, None] * radiance.flatten()
    return Sky(directions, irradiance, directions[..., None] * irradiance[:, None])


def sum_unscattered_sky(medium: Medium, lights: Sequence[object], degree: int) -> Moments | None:
    """Light of all skies in `lights` not yet scattered, to `degree` in angle; None of no sky.

    Mean and flux are (1 / (4 pi)) int L_ri dw and (3 / (4 pi)) int L_ri w dw over the sphere: Q0,
    and Q1 but for g (docs/theory.md section 1). Moments of higher degree take all light of a region
    as going along its middle (E17).
    """
    skies = _lit_skies(lights)
    if not skies:
        return None
    weights = torch.cat([_moment_weights(sky, degree) for sky in skies])
    return attenuate(medium, torch.cat([sky.travel for sky in skies]), weights)[0]


def _moment_weights(sky: Sky, degree: int) -> Tensor:
    """What transmittance is multiplied by, [N, moments, C]: the moments of light outside."""
    weights = [sky.irradiance[:, None]]
    if degree > 0:
        weights.append(3 * sky.vector)
    if degree > 1:
        weights.append(harmonics(sky.travel, degree)[4:].T[..., None] * sky.irradiance[:, None])
    return torch.cat(weights, 1) / (4 * math.pi)


def scatter_sky(medium: Medium, skies: Sequence[Sky], towards: Vector) -> Tensor:
    """Radiance `[C, z, y, x]` that `skies` scatter once `towards` a camera, per length and kappa_s.

    That is the inner integral of E2, sum over directions of p E tau / (4 pi), with the exact phase
    function p. `towards`: unit, its components broadcast to cells.
    """
    total = torch.zeros_like(medium.extinction.value)
    for sky in _lit_skies(skies):
        for travel, irradiance in zip(sky.travel, sky.irradiance, strict=True):
            total = total + recompute(_scatter_direction, medium, travel, irradiance, towards)
    return total / (4 * math.pi)


def _lit_skies(lights: Sequence[object]) -> list[Sky]:
    """The skies that differ from their mean, or may come to do so because they are being varied."""
    skies = [light for light in lights if isinstance(light, Sky)]
    return [
        sky
        for sky in skies
        if is_varied(sky.irradiance) or bool((sky.irradiance.detach() != 0).any())
    ]


def _scatter_direction(
    medium: Medium, travel: Tensor, irradiance: Tensor, towards: Vector
) -> Tensor:
    """p E tau at cells: what the light going along `travel` scatters `towards` a camera."""
    light, _ = attenuate(medium, travel[None], irradiance[None, None])
    z, y, x = (component * cosine for component, cosine in zip(travel, towards, strict=True))
    return light.mean * medium.seen.value(torch.atleast_3d(z + y + x))
