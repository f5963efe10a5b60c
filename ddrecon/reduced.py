"""Light not yet scattered: how much of it reaches each cell, and its moments Q0 and Q1 (docs/theory.md section 1).

A beam is followed by three vectorized operations on slices: shear the grid until the light runs along an axis, sum cumulatively
along that axis, shear back. Density and optical depth are interpolated, never their exponentials.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ddrecon.decay import decay_mean
from ddrecon.grid import Grid, array_order
from ddrecon.lights import AmbientLight, DirectionalLight, Light
from ddrecon.medium import Coefficient, Medium
from ddrecon.moments import Moments, beam_moments
from ddrecon.quadrature import sphere_quadrature
from ddrecon.sampling import sample_slices


@dataclass(frozen=True)
class Beam:
    """A directional light inside the volume: `mass` [K, z, y, x] is the integral of the extinction's field towards the light.

    `direction` [3] is its unit direction of travel in array order, `irradiance` [C, 1, 1, 1].
    """

    mass: Tensor
    direction: Tensor
    irradiance: Tensor


@dataclass(frozen=True)
class ReducedLight:
    """Light of directional lights not yet scattered: its `beams`, and its `source` Q0, Q1, averaged over cells (no Q1 where g = 0)."""

    beams: tuple[Beam, ...]
    source: Moments


def reduced_light(medium: Medium, lights: list[Light], has_flux: bool) -> ReducedLight:
    """The light of directional `lights` that reaches each cell unscattered; `has_flux`: whether Q1 is needed (g is not 0)."""
    beams, total = [], Moments(torch.zeros_like(medium.extinction.value))
    for light in lights:
        if isinstance(light, DirectionalLight):
            beam, received = _beam(medium, light, has_flux)
            beams.append(beam)
            total = total.plus(received)
    return ReducedLight(tuple(beams), total.scaled(1.0, 3 * medium.mean_cosine))


def ambient_radiance(lights: list[Light], like: Tensor) -> Tensor:
    """The radiance `[C, 1, 1, 1]` that all ambient `lights` together send in from every direction."""
    radiances = [light.radiance for light in lights if isinstance(light, AmbientLight)]
    return torch.stack(torch.broadcast_tensors(*radiances, like.new_zeros(1))).sum(0).view(-1, 1, 1, 1)


def unscattered_ambient(medium: Medium, radiance: Tensor, has_flux: bool) -> Moments:
    """Ambient light not yet scattered, to first order in angle: int L_ri and 3 int L_ri w over the sphere, divided by 4 pi.

    One direction at a time, so that memory does not grow with their number. `radiance`: [C, 1, 1, 1].
    """
    total = Moments(torch.zeros_like(medium.extinction.value))
    for direction, weight in zip(*sphere_quadrature(medium.extinction.field), strict=True):
        visible = checkpoint(_visibility, medium, direction, use_reentrant=False, preserve_rng_state=False)
        total = total.plus(beam_moments(weight * visible, direction, has_flux))
    return total.scaled(radiance, 3 * radiance)


def _beam(medium: Medium, light: DirectionalLight, has_flux: bool) -> tuple[Beam, Moments]:
    """The beam of `light`, and the moments of E tau / (4 pi) averaged over each cell along the beam."""
    direction = array_order(torch.nn.functional.normalize(light.direction, dim=0))
    irradiance = light.irradiance.view(-1, 1, 1, 1)
    entered, step = entered_mass(medium.extinction.field, medium.grid, direction)
    received = irradiance / (4 * math.pi) * _cell_mean(medium.extinction, entered, step)
    beam = Beam(entered + 0.5 * step * medium.extinction.field, direction, irradiance)
    return beam, beam_moments(received, direction, has_flux)


def _visibility(medium: Medium, direction: Tensor) -> Tensor:
    """Transmittance from the box to each cell along `direction`, averaged over the cell."""
    return _cell_mean(medium.extinction, *entered_mass(medium.extinction.field, medium.grid, direction))


def _cell_mean(extinction: Coefficient, entered: Tensor, step: Tensor) -> Tensor:
    """exp(-depth) averaged over each cell, along a beam that has `entered` mass behind it and crosses `step` [u] of the cell."""
    return torch.exp(-extinction.scale * entered) * decay_mean(extinction.scale * (extinction.field * step))


def entered_mass(field: Tensor, grid: Grid, direction: Tensor) -> tuple[Tensor, Tensor]:
    """The integral of `field` from the box to where a beam enters each cell's slice, and its path length within a slice [u].

    `field`: [K, z, y, x]; `direction`: [3], unit, array order, the way light travels. Slices are those across the axis along
    which the beam crosses most cells. Outside the box the field falls to zero within half a cell, which keeps the mass of the
    outer half cells. Returns `[K, z, y, x]` and a scalar.
    """
    speed = direction / direction.new_tensor(grid.spacing)
    axis = int(speed.detach().abs().argmax())
    order = [axis + 1, 0] + [1 + other for other in range(3) if other != axis]
    slices = field.permute(order)
    is_reversed = bool(direction[axis] < 0)
    if is_reversed:
        slices = slices.flip(0)
    slope = torch.stack([speed[other] for other in range(3) if other != axis]) / speed[axis].abs()
    step = grid.spacing[axis] / direction[axis].abs()
    sheared = _shear(slices, slope)
    before = (sheared.cumsum(0) - sheared) * step
    entered = _unshear(before, slope, (slices.shape[2], slices.shape[3]))
    if is_reversed:
        entered = entered.flip(0)
    return entered.permute([order.index(dim) for dim in range(4)]), step


def _shear(slices: Tensor, slope: Tensor) -> Tensor:
    """Slice k of `slices` [N, K, H, W] shifted by -k `slope` cells, on a lattice wide enough to hold every slice."""
    height, width = slices.shape[2:]
    rows, columns = (abs(base) for base in _bases(slices, slope))
    lattice = (height + rows, width + columns)
    return sample_slices(slices, _lattice_points(slices, lattice, slope, (height, width), 1), "zeros").unflatten(-1, lattice)


def _unshear(sheared: Tensor, slope: Tensor, size: tuple[int, int]) -> Tensor:
    """The inverse of `_shear`, back on slices of `size` cells."""
    height, width = sheared.shape[2:]
    return sample_slices(sheared, _lattice_points(sheared, size, slope, (height, width), -1), "border").unflatten(-1, size)


def _bases(slices: Tensor, slope: Tensor) -> list[int]:
    """Cells by which slices drift in all, along rows and columns, with the sign of `slope`; the first slice does not drift."""
    return [int(math.copysign(math.ceil(abs(s) * (slices.shape[0] - 1) - 1e-9), s)) for s in slope.tolist()]


def _lattice_points(slices: Tensor, lattice: tuple[int, int], slope: Tensor, source: tuple[int, int], sign: int) -> Tensor:
    """Where the points of `lattice` fall, slice by slice, in slices of `source` cells: shifted by `sign` k `slope`, in [-1, 1]."""
    index = torch.arange(slices.shape[0], dtype=slices.dtype, device=slices.device)
    lines = []
    for cells, shift, base, size in zip(lattice, slope, _bases(slices, slope), source, strict=True):
        drift = sign * (index * shift - max(base, 0))
        position = drift[:, None] + torch.arange(cells, dtype=slices.dtype, device=slices.device)
        lines.append((2 * position + 1) / size - 1)
    rows, columns = lines
    return torch.stack(torch.broadcast_tensors(columns[:, None, :], rows[:, :, None]), -1).flatten(1, 2)
