"""Light not yet scattered, L_ri: its beams, and the moments Q0 and Q1 that are the source of E2.4.

Of skies only sums over directions are kept, so memory does not grow with their number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

from ddrecon.light.beam import Beam, attenuate, attenuate_few, follow_beams, receive_beams
from ddrecon.light.lights import AmbientLight, DirectionalLight, PointLight
from ddrecon.light.moments import Moments, Vector
from ddrecon.light.pairs import TurnedBeam, follow_pair
from ddrecon.light.point_light import PointBeam, follow_point_light, receive_point_light
from ddrecon.light.sky import Sky, Source
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.remaining import has_backward_peak, remaining_moments
from ddrecon.numerics.autodiff import is_varied, recompute
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature
from ddrecon.numerics.remember import remember


def follow_lights(medium: Medium, lights: Sequence[Source]) -> tuple[Beam | PointBeam, ...]:
    """The beams of directional and point `lights` in `medium`."""
    directional = [light for light in lights if isinstance(light, DirectionalLight)]
    beams = follow_beams(medium, directional) if directional else []
    points = (light for light in lights if isinstance(light, PointLight))
    return (*beams, *(follow_point_light(medium, light) for light in points))


def receive_light(
    cells: Medium, lights: Sequence[Source], degree: int
) -> tuple[Moments, tuple[TurnedBeam, ...]]:
    """What each of `cells` receives unscattered of directional and point `lights`, as its mean.

    Of lights that go along w it is the sum of p_l Y_k(w) E tau / (4 pi), p_l being the moments of
    the scattering that remains (E2.8), for k up to `degree`: Q0, and Q1 with 3 g'. What backward
    peaks turn back belongs to the beams of directional lights, and is the second (E8.11).
    """
    sources: list[Moments] = []
    turned: list[TurnedBeam] = []
    directional = [light for light in lights if isinstance(light, DirectionalLight)]
    if directional and has_backward_peak(cells):
        for parallel in directional:
            pair = follow_pair(cells, parallel)
            sources.append(pair.source(cells))
            turned += pair.turned
    elif directional:
        sources.append(receive_beams(cells, directional, degree))
    for light in lights:
        if isinstance(light, PointLight):
            received = receive_point_light(cells, light, degree)
            sources.append(received.weighted(remaining_moments(cells)))
    nothing = Moments(torch.zeros_like(cells.extinction.value))
    return reduce(Moments.plus, sources) if sources else nothing, tuple(turned)


def ambient_radiance(lights: Sequence[object], like: Tensor) -> Tensor:
    """The radiance `[C, 1, 1, 1]` of all ambient `lights` together, the same from everywhere."""
    radiances = [light.radiance for light in lights if isinstance(light, AmbientLight)]
    return _add_radiances(like.dtype, like.device, *radiances)


@remember
def _add_radiances(dtype: torch.dtype, device: torch.device, *radiances: Tensor) -> Tensor:
    zero = torch.zeros(1, dtype=dtype, device=device)
    return torch.stack(torch.broadcast_tensors(*radiances, zero)).sum(0).view(-1, 1, 1, 1)


def ambient_sky(radiance: Tensor) -> Sky:
    """Ambient light of `radiance` [C, 1, 1, 1], as light from the directions of a quadrature."""
    directions, weights = sphere_quadrature(radiance)
    irradiance = 4 * math.pi * weights[:, None] * radiance.flatten()
    return Sky(directions, irradiance, directions[..., None] * irradiance[:, None])


def sum_unscattered_sky(medium: Medium, lights: Sequence[object], degree: int) -> Moments | None:
    """Light of all skies in `lights` not yet scattered, to `degree` in angle; None of no sky.

    Mean and flux are (1 / (4 pi)) int L_ri dw and (3 / (4 pi)) int L_ri w dw over the sphere: Q0,
    and Q1 but for g (docs/theory.md section 1). Moments of higher degree take all light of a region
    as going along its middle (E2.8).
    """
    skies = _lit_skies(lights)
    if not skies:
        return None
    weights = torch.cat([moment_weights(sky, degree) for sky in skies])
    return attenuate(medium, torch.cat([sky.travel for sky in skies]), weights)


def moment_weights(sky: Sky, degree: int) -> Tensor:
    """What transmittance is multiplied by, [N, moments, C]: the moments of light outside."""
    weights = [sky.irradiance[:, None]]
    if degree > 0:
        weights.append(3 * sky.vector)
    if degree > 1:
        weights.append(harmonics(sky.travel, degree)[4:].T[..., None] * sky.irradiance[:, None])
    return torch.cat(weights, 1) / (4 * math.pi)


def scatter_sky(medium: Medium, skies: Sequence[Sky], towards: Vector) -> Tensor:
    """Radiance `[C, z, y, x]` that `skies` scatter once `towards` a camera, per length and kappa_s.

    That is the inner integral of E2.2, sum over directions of p E tau / (4 pi), with the exact
    phase function p. `towards`: unit, its components broadcast to cells.
    """

    def scatter(travel: Tensor, irradiance: Tensor) -> Tensor:
        """p E tau of the light that goes along `travel`."""
        (visible,) = attenuate_few(medium, travel[None], irradiance[None, None])
        z, y, x = (component * cosine for component, cosine in zip(travel, towards, strict=True))
        return visible * medium.seen.value(torch.atleast_3d(z + y + x))

    total = torch.zeros_like(medium.extinction.value)
    for sky in _lit_skies(skies):
        for travel, irradiance in zip(sky.travel, sky.irradiance, strict=True):
            total = total + recompute(scatter, travel, irradiance)
    return total / (4 * math.pi)


def _lit_skies(lights: Sequence[object]) -> list[Sky]:
    """The skies that differ from their mean, or may come to do so because they are being varied."""
    skies = [light for light in lights if isinstance(light, Sky)]
    return [
        sky
        for sky in skies
        if is_varied(sky.irradiance) or bool((sky.irradiance.detach() != 0).any())
    ]
