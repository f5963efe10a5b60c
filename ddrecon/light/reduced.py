"""Light not yet scattered, L_ri: its beams, and the moments Q0 and Q1 that are the source of E2.4.

Of skies only sums over directions are kept, so memory does not grow with their number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from torch import Tensor

from ddrecon.light.beam import Beam, attenuate, attenuate_few, follow_beams
from ddrecon.light.lights import AmbientLight, BeamLight, DirectionalLight, PointLight
from ddrecon.light.moments import Moments, Vector
from ddrecon.light.pairs import TurnedBeam, follow_pair
from ddrecon.light.point_light import PointBeam, follow_point_light
from ddrecon.light.profile import profile_in
from ddrecon.light.sky import Sky, Source
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.remaining import remaining_moments
from ddrecon.numerics.autodiff import is_varied, recompute
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature
from ddrecon.numerics.remember import remember


@dataclass(frozen=True)
class ReducedLight:
    """Light of beams not yet scattered.

    `source`: Q0, Q1 and what follows, of all `beams` together, averaged over cells, to the degree
    that was wanted. `mean` [C, z, y, x]: that of their light itself over directions and cells, what
    peaks have turned among it. `turned`: light that backward peaks have turned back and forth
    (E8.11).
    """

    beams: tuple[Beam | PointBeam, ...]
    source: Moments
    mean: Tensor
    turned: tuple[TurnedBeam, ...] = ()

    def plus(self, other: ReducedLight) -> ReducedLight:
        """The light of both."""
        source, turned = self.source.plus(other.source), self.turned + other.turned
        return ReducedLight(self.beams + other.beams, source, self.mean + other.mean, turned)

    def across(self, profile: Tensor) -> ReducedLight:
        """This light of directional lights, its irradiance times `profile` [1, z, y, x]."""
        beams = (replace(beam, profile=profile) for beam in self.beams if isinstance(beam, Beam))
        source = self.source.scaled(profile, profile, profile)
        turned = (replace(one, radiance=profile * one.radiance) for one in self.turned)
        return ReducedLight(tuple(beams), source, profile * self.mean, tuple(turned))


def reduced_light(
    medium: Medium, lights: Sequence[Source], degree: int, has_pairs: bool = False
) -> ReducedLight:
    """The light of directional, point and beam `lights` that reaches each cell unscattered.

    Of lights that go along w the source holds the sum of p_l Y_k(w) E tau / (4 pi), p_l being the
    moments of the scattering that remains (E2.8), for k up to `degree`: Q0, and Q1 with 3 g'. With
    `has_pairs`, what backward peaks turn back belongs to the beams of parallel light (E8.11).
    """
    parts = list[ReducedLight]()
    if parallel := [light for light in lights if isinstance(light, DirectionalLight)]:
        parts.append(_follow_parallel(medium, parallel, degree, has_pairs))
    for light in lights:
        if isinstance(light, PointLight):
            point_beam, received = follow_point_light(medium, light, degree)
            source = received.weighted(remaining_moments(medium))
            parts.append(ReducedLight((point_beam,), source, received.mean))
        elif isinstance(light, BeamLight):
            parallel = [DirectionalLight(light.direction, light.power)]
            found = _follow_parallel(medium, parallel, degree, has_pairs)
            shape = light.position, light.direction, light.radius
            parts.append(found.across(profile_in(medium.grid, *shape)))
    nothing = torch.zeros_like(medium.extinction.value)
    return (
        reduce(ReducedLight.plus, parts) if parts else ReducedLight((), Moments(nothing), nothing)
    )


def _follow_parallel(
    medium: Medium, lights: Sequence[DirectionalLight], degree: int, has_pairs: bool
) -> ReducedLight:
    """The light of directional `lights`, at least one; arguments as of `reduced_light`."""
    if not has_pairs:
        beams, source = follow_beams(medium, lights, degree)
        return ReducedLight(tuple(beams), source, source.mean)
    parts = list[ReducedLight]()
    for light in lights:
        beam, pair = follow_pair(medium, light)
        mean = pair.along + pair.against
        parts.append(ReducedLight((beam,), pair.source(medium), mean, pair.turned))
    return reduce(ReducedLight.plus, parts)


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

    That is the inner integral of E2.2, sum over directions of p E tau / (4 pi), with the exact
    phase function p. `towards`: unit, its components broadcast to cells.
    """

    def scatter(travel: Tensor, irradiance: Tensor) -> Tensor:
        """p E tau of the light that goes along `travel`."""
        (visible,), _ = attenuate_few(medium, travel[None], irradiance[None, None])
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
