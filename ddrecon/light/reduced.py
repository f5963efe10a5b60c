"""Light not yet scattered, L_ri: its beams, and the moments Q0 and Q1 that are the source of E4.

Here are directional and point lights and the radiance of ambient light; skies are in `skylight.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from ddrecon.light.beam import Beam, follow_beam
from ddrecon.light.lights import AmbientLight, DirectionalLight, PointLight
from ddrecon.light.moments import Moments
from ddrecon.light.point_light import PointBeam, follow_point_light
from ddrecon.light.sky import Source
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import is_fused
from ddrecon.numerics.remember import remember


@dataclass(frozen=True)
class ReducedLight:
    """Light of directional and point lights not yet scattered.

    `source`: Q0 and Q1 of all `beams` together, averaged over cells; no Q1 where it was not wanted.
    """

    beams: tuple[Beam | PointBeam, ...]
    source: Moments


def reduced_light(medium: Medium, lights: Sequence[Source], has_flux: bool) -> ReducedLight:
    """The light of directional and point `lights` that reaches each cell unscattered.

    Q0 = sum of E tau / (4 pi) and Q1 = 3 g' sum of E tau w / (4 pi) over lights that go along w, g'
    being the mean cosine of the scattering that remains. Without `has_flux` no Q1 is computed.
    """
    beams: dict[int, Beam | PointBeam] = {}
    parts, received = [], []
    directional = {
        i: light for i, light in enumerate(lights) if isinstance(light, DirectionalLight)
    }
    if directional and is_fused():
        from ddrecon.light.fused.beams import follow_beams

        found, moments = follow_beams(medium, list(directional.values()), has_flux)
        beams.update(zip(directional, found, strict=True))
        parts.append(moments)
    for i, light in enumerate(lights):
        if i not in beams and isinstance(light, DirectionalLight | PointLight):
            beams[i], moments = (
                follow_beam(medium, light, has_flux)
                if isinstance(light, DirectionalLight)
                else follow_point_light(medium, light, has_flux)
            )
            received.append(moments)
    if received:
        parts.append(reduce(Moments.plus, received).scaled(1.0, 3 * medium.mean_cosine))
    elif not parts:
        parts.append(Moments(torch.zeros_like(medium.extinction.value)))
    return ReducedLight(tuple(beams[i] for i in sorted(beams)), reduce(Moments.plus, parts))


def ambient_radiance(lights: Sequence[object], like: Tensor) -> Tensor:
    """The radiance `[C, 1, 1, 1]` of all ambient `lights` together, the same from everywhere."""
    radiances = [light.radiance for light in lights if isinstance(light, AmbientLight)]
    return _add_radiances(like.dtype, like.device, *radiances)


@remember
def _add_radiances(dtype: torch.dtype, device: torch.device, *radiances: Tensor) -> Tensor:
    zero = torch.zeros(1, dtype=dtype, device=device)
    return torch.stack(torch.broadcast_tensors(*radiances, zero)).sum(0).view(-1, 1, 1, 1)
