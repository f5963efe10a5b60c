"""Beams of directional lights and light of skies inside a medium, by fused kernels.

The same as `light.beam` and `light.skylight` have it, for all directions at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.grid import Grid, array_order
from ddrecon.light.beam import Beam
from ddrecon.light.fused.shear import Shear
from ddrecon.light.fused.unscattered import Unscattered
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium, along_colors
from ddrecon.numerics.remember import remember
from ddrecon.numerics.slicing import Slicing, across


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
    centers = zip(found[count:], numbers, strict=False)
    masses = [torch.addcmul(one, extinction.field, 0.5 * number[2]) for one, number in centers]
    return Moments(mean, flux, higher), masses


def sum_mass(
    field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float
) -> tuple[Tensor, Tensor]:
    """The mass `[K, z, y, x]` up to where a beam enters each cell, and its path in a slice [u]."""
    shears, numbers = follow(grid, direction[None], bound)
    nothing = field.new_empty(1, 0, 1)
    (entered,) = Unscattered.apply(shears, True, field, field.new_ones(1), numbers, nothing)
    return entered, numbers[0, 2]


@remember
def follow(
    grid: Grid, directions: Tensor, bound: Tensor | float
) -> tuple[tuple[Shear, ...], Tensor]:
    """How beams along `directions` [L, 3] cross slices, and the numbers [L, 4] of each.

    These are the slope by rows and by columns, the path in a slice [u] and the `bound`.
    """
    shears, numbers = _cross(grid, directions)
    bounds = torch.as_tensor(bound).to(numbers).expand(len(numbers), 1)
    return shears, torch.cat([numbers, bounds], 1)


@remember
def _cross(grid: Grid, directions: Tensor) -> tuple[tuple[Shear, ...], Tensor]:
    """The same without bounds: directions are read, whatever the `bound` is made of."""
    speed = directions / directions.new_tensor(grid.spacing)
    slicings = [Slicing.of(each) for each in speed.tolist()]
    order = [[*across(slicing.axis), slicing.axis] for slicing in slicings]
    ordered = speed.gather(1, torch.tensor(order, device=speed.device))
    fastest = ordered[:, 2:].abs()
    slope = ordered[:, :2] / fastest
    slopes = [(row, column) for row, column in slope.tolist()]
    shears = tuple(Shear(grid, *each) for each in zip(slicings, slopes, strict=True))
    return shears, torch.cat([slope, 1 / fastest], 1)
