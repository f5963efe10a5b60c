"""Beams of directional lights and light of skies inside a medium, by fused kernels.

The same as `light.beam` and `light.skylight` have it, for all directions at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.grid import array_order
from ddrecon.light.beam import Beam
from ddrecon.light.fused.sum_mass import follow
from ddrecon.light.fused.unscattered import Unscattered
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium


def follow_beams(
    medium: Medium, lights: Sequence[DirectionalLight], has_flux: bool
) -> tuple[list[Beam], Moments]:
    """The beams of `lights` in `medium`, and Q0 and Q1 of all of them (E2); no Q1 without flux."""
    directions = torch.stack(
        [torch.nn.functional.normalize(array_order(light.direction), dim=0) for light in lights]
    )
    colors = torch.broadcast_tensors(*(light.irradiance for light in lights))
    irradiance = torch.stack(colors)
    weights = irradiance[:, None] / (4 * math.pi)
    if has_flux:
        flux = 3 * medium.mean_cosine * directions[..., None] * weights
        weights = torch.cat([weights, flux], 1)
    moments, masses = attenuate(medium, directions, weights, has_mass=True)
    beams = [
        Beam(mass, direction, light.irradiance.view(-1, 1, 1, 1))
        for mass, direction, light in zip(masses, directions, lights, strict=True)
    ]
    return beams, moments


def attenuate(
    medium: Medium, directions: Tensor, weights: Tensor, *, has_mass: bool = False
) -> tuple[Moments, list[Tensor]]:
    """The sum over L beams along `directions` [L, 3] of `weights` times tau, averaged over cells.

    `weights` [L, 1 or 4, C]: for the mean, and along z, y, x for the flux. Also the mass up to
    cells' centers [K, z, y, x] of each beam where it `has_mass`.
    """
    extinction = medium.extinction
    shears, numbers = follow(medium.grid, directions, extinction.mass_bound)
    colors = max(weights.shape[2], len(extinction.scale))
    scale = extinction.scale.flatten().expand(colors)
    found = Unscattered.apply(
        shears,
        has_mass,
        extinction.field,
        scale,
        numbers,
        weights.expand(-1, -1, colors),
    )
    moments, masses = found[: weights.shape[1]], found[weights.shape[1] :]
    mean, *flux = moments
    if not flux:
        return Moments(mean), list(masses)
    z, y, x = flux
    return Moments(mean, (z, y, x)), list(masses)
