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
from ddrecon.medium.coefficients import Medium, along_colors
from ddrecon.numerics.remember import remember


def follow_beams(
    medium: Medium, lights: Sequence[DirectionalLight], has_flux: bool
) -> tuple[list[Beam], Moments]:
    """The beams of `lights` in `medium`, and Q0 and Q1 of all of them (E2); no Q1 without flux."""
    directions, *each = _directions(*(light.direction for light in lights))
    cosine = medium.mean_cosine if has_flux else None
    weights = _weights(directions, cosine, *(light.irradiance for light in lights))
    moments, masses = attenuate(medium, directions, weights, has_mass=True)
    beams = [
        Beam(mass, direction, along_colors(light.irradiance))
        for mass, direction, light in zip(masses, each, lights, strict=True)
    ]
    return beams, moments


@remember
def _directions(*directions: Tensor) -> tuple[Tensor, ...]:
    """Unit `directions` (z, y, x) beside each other, [L, 3], and one by one."""
    each = [torch.nn.functional.normalize(array_order(one), dim=0) for one in directions]
    return torch.stack(each), *each


@remember
def _weights(directions: Tensor, mean_cosine: Tensor | None, *irradiances: Tensor) -> Tensor:
    """What `attenuate` is to weight beams by: E / (4 pi), and 3 g' w times that for the flux."""
    weights = torch.stack(torch.broadcast_tensors(*irradiances))[:, None] / (4 * math.pi)
    if mean_cosine is None:
        return weights
    flux = 3 * mean_cosine.view(-1) * directions[..., None] * weights
    return torch.cat([weights.expand(-1, -1, flux.shape[2]), flux], 1)


def attenuate(
    medium: Medium, directions: Tensor, weights: Tensor, *, has_mass: bool = False
) -> tuple[Moments, list[Tensor]]:
    """The sum over L beams along `directions` [L, 3] of `weights` times tau, averaged over cells.

    `weights` [L, moments, C]: for the mean, along z, y, x for the flux, and for all higher moments.
    Also the mass up to cells' centers [K, z, y, x] of each beam where it `has_mass`.
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
    count = len(found) - len(shears) * has_mass
    mean, *more = found[:count]
    flux = (more[0], more[1], more[2]) if more else None
    higher = more[3] if len(more) > 3 else None
    return Moments(mean, flux, higher), list(found[count:])
