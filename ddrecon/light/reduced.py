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

from ddrecon.light.beam import Beam, attenuate, attenuate_few, follow_beams, receive_beams
from ddrecon.light.lights import AmbientLight, BeamLight, DirectionalLight, PointLight
from ddrecon.light.moments import add, moments_of_flux, weigh
from ddrecon.light.pairs import ReversedBeam, follow_pair
from ddrecon.light.point_light import PointBeam, follow_point_light, receive_point_light
from ddrecon.light.profile import RefractedBeam, enter_faces, profile_in, refract_skies
from ddrecon.light.sky import Sky, Source
from ddrecon.medium.coefficients import Medium, has_backward_peak, remaining_moments
from ddrecon.numerics.autodiff import is_varied, recompute
from ddrecon.numerics.layout import Unrolled
from ddrecon.numerics.remember import remember
from ddrecon.numerics.sphere import harmonics, sphere_quadrature


@dataclass(frozen=True)
class Received:
    """What each cell receives of light that is not yet scattered, averaged over the cell.

    `source` [K, C, z, y, x]: Q0, Q1 and what follows, to a degree. `mean` [C, z, y, x]: the light's
    mean over directions. `turned`: light that backward peaks have turned (E8.11), part of the mean.
    """

    source: Tensor
    mean: Tensor
    turned: tuple[ReversedBeam, ...] = ()

    def plus(self, more: Received) -> Received:
        """The light of both."""
        source, turned = add(self.source, more.source), self.turned + more.turned
        return Received(source, self.mean + more.mean, turned)

    def across(self, profile: Tensor) -> Received:
        """This light of directional lights, its irradiance times `profile` [1, z, y, x]."""
        turned = (replace(beam, radiance=profile * beam.radiance) for beam in self.turned)
        return Received(profile * self.source, profile * self.mean, tuple(turned))


def follow_lights(medium: Medium, lights: Sequence[Source]) -> tuple[Beam | PointBeam, ...]:
    """The beams of directional, point and beam `lights` in `medium`."""
    even, confined, points = _sort_lights(medium, lights)
    beams: list[Beam | PointBeam] = [*follow_beams(medium, even)] if even else []
    for entered in confined:
        (beam,) = follow_beams(medium, [entered.light])
        beams.append(replace(beam, profile=entered.profile))
    return (*beams, *(follow_point_light(medium, light) for light in points))


def _sort_lights(
    medium: Medium, lights: Sequence[Source]
) -> tuple[list[DirectionalLight], list[RefractedBeam], list[PointLight]]:
    """Those of `lights` that are the same in all of the box, beams that are not, and points."""
    even, confined = list[DirectionalLight](), list[RefractedBeam]()
    for light in lights:
        if medium.index != 1 and isinstance(light, DirectionalLight | BeamLight):
            confined += enter_faces(medium.grid, medium.index, light)
        elif isinstance(light, BeamLight):
            profile = profile_in(medium.grid, light.position, light.direction, light.radius)
            power = DirectionalLight(light.direction, light.power)
            confined.append(RefractedBeam(power, profile))
        elif isinstance(light, DirectionalLight):
            even.append(light)
    return even, confined, [light for light in lights if isinstance(light, PointLight)]


def receive_light(
    cells: Medium, lights: Sequence[Source], degree: int, narrow: Medium | None = None
) -> Received:
    """What `cells` receive of directional, point and beam `lights`.

    The source of lights that go along w is the sum of p_l Y_k(w) E tau / (4 pi), with the moments
    p_l of the scattering that remains (E2.8), for k up to `degree`: Q0, and Q1 with 3 g'. What
    backward peaks turn back belongs to the beams of parallel light (E8.11). Parallel light
    is that of the parts of `narrow` cells, where there are any (E5.10).
    """
    even, confined, points = _sort_lights(cells, lights)
    lit = [_receive_parallel(cells, even, degree, narrow)] if even else []
    for beam in confined:
        lit.append(_receive_parallel(cells, [beam.light], degree, narrow).across(beam.profile))
    for light in points:
        phi = receive_point_light(cells, light, degree)
        lit.append(Received(weigh(phi, remaining_moments(cells)), phi[0]))
    dark = torch.zeros_like(cells.extinction.value)
    return reduce(Received.plus, lit) if lit else Received(dark[None], dark)


def _receive_parallel(
    cells: Medium, lights: Sequence[DirectionalLight], degree: int, narrow: Medium | None = None
) -> Received:
    if not has_backward_peak(cells):
        source = receive_beams(cells, lights, degree, narrow)
        return Received(source, source[0])
    pairs = [follow_pair(cells, light, narrow) for light in lights]
    lit = (Received(pair.source(cells), pair.along + pair.against, pair.turned) for pair in pairs)
    return reduce(Received.plus, lit)


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


def sum_unscattered_sky(medium: Medium, lights: Sequence[object], degree: int) -> Tensor | None:
    """phi of all skies in `lights` not yet scattered, to `degree` in angle; None of no sky.

    Mean and flux are exact; moments of higher degree take all light of a region as going along its
    middle (E2.8).
    """
    lit = []
    for sky, profile in _lit_skies(medium, lights):
        phi = attenuate(medium, sky.travel, moment_weights(sky, degree))
        lit.append(phi if profile is None else profile * phi)
    return reduce(torch.add, lit) if lit else None


def moment_weights(sky: Sky, degree: int) -> Tensor:
    """What transmittance is multiplied by, [N, K, C]: the moments phi of light outside."""
    weights = [sky.irradiance[:, None]]
    if degree > 0:
        weights.append(3 * moments_of_flux(sky.vector.unbind(1)).transpose(0, 1))
    if degree > 1:
        weights.append(harmonics(sky.travel, degree)[4:].T[..., None] * sky.irradiance[:, None])
    return torch.cat(weights, 1) / (4 * math.pi)


def scatter_sky(
    medium: Medium, skies: Sequence[Sky], towards: Sequence[Tensor], period: Unrolled
) -> Tensor:
    """Radiance `[C, z, y, x]` that `skies` scatter once `towards` a camera, per length and kappa_s.

    That is the inner integral of E2.2, sum over directions of p E tau / (4 pi), with the exact
    phase function p. `towards`: unit; its components and the result are those of a `period`.
    """

    def scatter(travel: Tensor, irradiance: Tensor) -> Tensor:
        """p E tau of the light that goes along `travel`."""
        (visible,) = attenuate_few(medium, travel[None], irradiance[None, None])
        z, y, x = (component * cosine for component, cosine in zip(travel, towards, strict=True))
        return period.extend(visible) * medium.seen.phase.value(torch.atleast_3d(z + y + x))

    total = period.extend(torch.zeros_like(medium.extinction.value))
    for sky, profile in _lit_skies(medium, skies):
        for travel, irradiance in zip(sky.travel, sky.irradiance, strict=True):
            light = recompute(scatter, travel, irradiance)
            total = total + (light if profile is None else profile * light)
    return total / (4 * math.pi)


def _lit_skies(medium: Medium, lights: Sequence[object]) -> list[tuple[Sky, Tensor | None]]:
    """The skies that differ from their mean, or may come to do so because they are being varied.

    Where `medium` refracts light it is that of each region behind each face, with its profile.
    """
    skies = [
        sky
        for sky in lights
        if isinstance(sky, Sky)
        and len(sky.travel)
        and (is_varied(sky.irradiance) or bool((sky.irradiance != 0).any()))
    ]
    if medium.index != 1:
        return [*refract_skies(medium.grid, medium.index, skies)]
    return [(sky, None) for sky in skies]
