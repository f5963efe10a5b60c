"""Light not yet scattered: how much of it reaches each cell, and its moments Q0 and Q1
(docs/theory.md section 1).

A beam is followed by three vectorized operations on slices: shear the grid until the light runs
along an axis, sum cumulatively along that axis, shear back. Density and optical depth are
interpolated, never their exponentials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.light.beam import Beam, follow_beam
from ddrecon.light.lights import AmbientLight, DirectionalLight, PointLight
from ddrecon.light.moments import Moments
from ddrecon.light.point_light import PointBeam, follow_point_light
from ddrecon.light.sky import Source
from ddrecon.medium.coefficients import Medium


@dataclass(frozen=True)
class ReducedLight:
    """Light of directional and point lights not yet scattered: `beams`, and their `source` Q0, Q1
    averaged over cells (no Q1 for g = 0).
    """

    beams: tuple[Beam | PointBeam, ...]
    source: Moments


def reduced_light(medium: Medium, lights: Sequence[Source], has_flux: bool) -> ReducedLight:
    """The light of directional and point `lights` that reaches each cell unscattered; `has_flux`:
    whether Q1 is needed (g is not 0).
    """
    beams: list[Beam | PointBeam] = []
    total = Moments(torch.zeros_like(medium.extinction.value))
    for light in lights:
        if isinstance(light, DirectionalLight | PointLight):
            beam, received = (
                follow_beam(medium, light, has_flux)
                if isinstance(light, DirectionalLight)
                else follow_point_light(medium, light, has_flux)
            )
            beams.append(beam)
            total = total.plus(received)
    return ReducedLight(tuple(beams), total.scaled(1.0, 3 * medium.mean_cosine))


def ambient_radiance(lights: Sequence[object], like: Tensor) -> Tensor:
    """The radiance `[C, 1, 1, 1]` that all ambient `lights` together send in from every direction."""
    radiances = [light.radiance for light in lights if isinstance(light, AmbientLight)]
    return (
        torch.stack(torch.broadcast_tensors(*radiances, like.new_zeros(1))).sum(0).view(-1, 1, 1, 1)
    )
