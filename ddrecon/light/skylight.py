"""Light of skies not yet scattered: a march for each direction, one at a time.

Only sums over directions are kept, so memory does not grow with their number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.light.moments import Moments, Vector
from ddrecon.light.shear import sum_mass_to_cells
from ddrecon.light.sky import Sky
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import is_fused, is_varied, recompute
from ddrecon.numerics.quadrature import sphere_quadrature


def ambient_sky(radiance: Tensor) -> Sky:
    """Ambient light of `radiance` [C, 1, 1, 1], as light from the directions of a quadrature."""
    directions, weights = sphere_quadrature(radiance)
    irradiance = 4 * math.pi * weights[:, None] * radiance.flatten()
    return Sky(directions, irradiance, directions[..., None] * irradiance[:, None])


def sum_unscattered_sky(medium: Medium, lights: Sequence[object], has_flux: bool) -> Moments | None:
    """Light of all skies in `lights` not yet scattered, to first order in angle; None of no sky.

    Mean and flux are (1 / (4 pi)) int L_ri dw and (3 / (4 pi)) int L_ri w dw over the sphere: Q0,
    and Q1 but for g (docs/theory.md section 1). Without `has_flux` there is no flux.
    """
    skies = _lit_skies(lights)
    if skies and is_fused():
        return _sum_fused(medium, skies, has_flux)
    total = None
    for sky in skies:
        vectors = sky.vector if has_flux else [None] * len(sky.travel)
        for travel, irradiance, vector in zip(sky.travel, sky.irradiance, vectors, strict=True):
            part = recompute(_attenuate_direction, medium, travel, irradiance, vector)
            total = part if total is None else total.plus(part)
    return None if total is None else total.scaled(1 / (4 * math.pi), 3 / (4 * math.pi))


def _sum_fused(medium: Medium, skies: Sequence[Sky], has_flux: bool) -> Moments:
    """What `sum_unscattered_sky` returns, by fused kernels: directions one after the other."""
    from ddrecon.light.fused.beams import attenuate

    mean, flux = torch.cat([sky.irradiance for sky in skies]), torch.cat([s.vector for s in skies])
    weights = torch.cat([mean[:, None], 3 * flux], 1) if has_flux else mean[:, None]
    directions = torch.cat([sky.travel for sky in skies])
    return attenuate(medium, directions, weights / (4 * math.pi))[0]


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
    visible = _attenuate_direction(medium, travel, irradiance, None).mean
    z, y, x = (component * cosine for component, cosine in zip(travel, towards, strict=True))
    return visible * medium.seen.value(z + y + x)


def _attenuate_direction(
    medium: Medium, direction: Tensor, irradiance: Tensor, vector: Tensor | None
) -> Moments:
    """`irradiance` ([C] or scalar) and `vector` [3, C], each times tau along `direction`.

    tau is averaged over each cell.
    """
    if is_fused() and vector is None:
        from ddrecon.light.fused.beams import attenuate

        return attenuate(medium, direction[None], irradiance.view(1, 1, -1))[0]
    extinction = medium.extinction
    entered, step = sum_mass_to_cells(
        extinction.field, medium.grid, direction, extinction.mass_bound
    )
    visible = extinction.mean_transmittance(entered, step)
    mean = visible * irradiance.view(-1, 1, 1, 1)
    if vector is None:
        return Moments(mean)
    z, y, x = (visible * component.view(-1, 1, 1, 1) for component in vector)
    return Moments(mean, (z, y, x))
