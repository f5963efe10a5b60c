"""Light not yet scattered, L_ri: its beams, and the moments Q0 and Q1 that are the source of E4.

Here are directional and point lights and the radiance of ambient light; skies are in `skylight.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from ddrecon.light.beam import Beam, follow_beams
from ddrecon.light.lights import AmbientLight, DirectionalLight, PointLight
from ddrecon.light.moments import Moments
from ddrecon.light.pairs import TurnedBeam, follow_pair
from ddrecon.light.point_light import PointBeam, follow_point_light
from ddrecon.light.sky import Source
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.remaining import remaining_moments
from ddrecon.numerics.remember import remember


@dataclass(frozen=True)
class ReducedLight:
    """Light of directional and point lights not yet scattered.

    `source`: Q0, Q1 and what follows, of all `beams` together, averaged over cells, to the degree
    that was wanted. `turned`: light that backward peaks have turned back and forth (E20).
    """

    beams: tuple[Beam | PointBeam, ...]
    source: Moments
    turned: tuple[TurnedBeam, ...] = ()


def reduced_light(
    medium: Medium, lights: Sequence[Source], degree: int, has_pairs: bool = False
) -> ReducedLight:
    """The light of directional and point `lights` that reaches each cell unscattered.

    Of lights that go along w the source holds the sum of p_l Y_k(w) E tau / (4 pi), p_l being the
    moments of the scattering that remains (E17), for k up to `degree`: Q0, and Q1 with 3 g'. With
    `has_pairs`, what backward peaks turn back belongs to the beams of directional lights (E20).
    """
    beams: list[Beam | PointBeam] = []
    sources: list[Moments] = []
    turned: list[TurnedBeam] = []
    directional = [light for light in lights if isinstance(light, DirectionalLight)]
    if has_pairs:
        for light in directional:
            beam, pair = follow_pair(medium, light)
            beams.append(beam)
            sources.append(pair.source(medium))
            turned += pair.turned
    elif directional:
        found, source = follow_beams(medium, directional, degree)
        beams += found
        sources.append(source)
    for light in lights:
        if isinstance(light, PointLight):
            point_beam, received = follow_point_light(medium, light, degree)
            beams.append(point_beam)
            sources.append(received.weighted(remaining_moments(medium)))
    nothing = Moments(torch.zeros_like(medium.extinction.value))
    source = reduce(Moments.plus, sources) if sources else nothing
    return ReducedLight(tuple(beams), source, tuple(turned))


def ambient_radiance(lights: Sequence[object], like: Tensor) -> Tensor:
    """The radiance `[C, 1, 1, 1]` of all ambient `lights` together, the same from everywhere."""
    radiances = [light.radiance for light in lights if isinstance(light, AmbientLight)]
    return _add_radiances(like.dtype, like.device, *radiances)


@remember
def _add_radiances(dtype: torch.dtype, device: torch.device, *radiances: Tensor) -> Tensor:
    zero = torch.zeros(1, dtype=dtype, device=device)
    return torch.stack(torch.broadcast_tensors(*radiances, zero)).sum(0).view(-1, 1, 1, 1)
