"""Light not yet scattered: how much of it reaches each cell, and its moments Q0 and Q1 (THEORY section 1).

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
    """Light not yet scattered: the beams, and the moments of everything else that shines (`ambient_*`, None without).

    `source_mean` Q0 [C, z, y, x] and `source_flux` Q1 [3, C, z, y, x] (array order, None where g = 0) are of all lights, as
    averages over cells; `ambient_mean` [C, z, y, x] and `ambient_flux` [3, C, z, y, x] are int L_ri and int L_ri w over the
    sphere, divided by 4 pi, of ambient light alone.
    """

    beams: tuple[Beam, ...]
    ambient_mean: Tensor | None
    ambient_flux: Tensor | None
    source_mean: Tensor
    source_flux: Tensor | None


def reduced_light(medium: Medium, lights: list[Light], has_flux: bool) -> ReducedLight:
    """The light of `lights` that reaches each cell of `medium` unscattered; `has_flux`: whether Q1 is needed (g is not 0)."""
    extinction = medium.extinction
    mean = torch.zeros_like(extinction.scale)
    flux = torch.zeros_like(extinction.scale) if has_flux else None
    beams = []
    for light in lights:
        if isinstance(light, DirectionalLight):
            beam, received = _beam(extinction, medium.grid, light)
            beams.append(beam)
            mean = mean + received
            if flux is not None:
                flux = flux + received * beam.direction.view(3, 1, 1, 1, 1)
    ambient_mean, ambient_flux = _ambient(extinction, medium.grid, lights)
    if ambient_mean is not None and ambient_flux is not None:
        mean = mean + ambient_mean
        flux = flux + ambient_flux if flux is not None else None
    shape = (*torch.broadcast_shapes(mean.shape[:1], extinction.scale.shape[:1]), *medium.grid.shape)
    source_flux = 3 * medium.mean_cosine * flux.expand(3, *shape) if flux is not None else None
    return ReducedLight(tuple(beams), ambient_mean, ambient_flux, mean.expand(shape), source_flux)


def _beam(extinction: Coefficient, grid: Grid, light: DirectionalLight) -> tuple[Beam, Tensor]:
    """The beam of `light`, and E tau / (4 pi) averaged over each cell along the beam."""
    direction = array_order(torch.nn.functional.normalize(light.direction, dim=0))
    irradiance = light.irradiance.view(-1, 1, 1, 1)
    entered, step = entered_mass(extinction.field, grid, direction)
    own = extinction.field * step
    received = torch.exp(-extinction.scale * entered) * decay_mean(extinction.scale * own)
    return Beam(entered + 0.5 * own, direction, irradiance), irradiance / (4 * math.pi) * received


def _ambient(extinction: Coefficient, grid: Grid, lights: list[Light]) -> tuple[Tensor | None, Tensor | None]:
    """Mean and flux over directions of all ambient light; one direction at a time, so that memory does not grow with their number."""
    radiance = [light.radiance.view(-1, 1, 1, 1) for light in lights if isinstance(light, AmbientLight)]
    if not radiance:
        return None, None
    directions, weights = sphere_quadrature(extinction.field)
    mean, flux = torch.zeros_like(extinction.value), torch.zeros_like(extinction.value).expand(3, -1, -1, -1, -1).clone()
    for direction, weight in zip(directions, weights, strict=True):
        arriving = weight * checkpoint(_visibility, extinction, grid, direction, use_reentrant=False, preserve_rng_state=False)
        mean = mean + arriving
        flux = flux + arriving * direction.view(3, 1, 1, 1, 1)
    total = torch.stack(torch.broadcast_tensors(*radiance)).sum(0) if len(radiance) > 1 else radiance[0]
    return total * mean, total * flux


def _visibility(extinction: Coefficient, grid: Grid, direction: Tensor) -> Tensor:
    entered, step = entered_mass(extinction.field, grid, direction)
    return torch.exp(-extinction.scale * entered) * decay_mean(extinction.scale * extinction.field * step)


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
    entered = _unshear(before, slope, slices.shape[2:])
    if is_reversed:
        entered = entered.flip(0)
    return entered.permute([order.index(dim) for dim in range(4)]), step


def _shear(slices: Tensor, slope: Tensor) -> Tensor:
    """Slice k of `slices` [N, K, H, W] shifted by -k `slope` cells, on a lattice wide enough to hold every slice."""
    count, _, height, width = slices.shape
    reach = [math.ceil(abs(s) * (count - 1) - 1e-9) for s in slope.tolist()]
    lattice = (height + reach[0], width + reach[1])
    points = _lattice_points(slices, lattice, slope, (height, width), sign=1)
    return sample_slices(slices, points, "zeros").unflatten(-1, lattice)


def _unshear(sheared: Tensor, slope: Tensor, size: torch.Size) -> Tensor:
    """The inverse of `_shear`, back on slices of `size` cells."""
    points = _lattice_points(sheared, (size[0], size[1]), slope, sheared.shape[2:], sign=-1)
    return sample_slices(sheared, points, "border").unflatten(-1, (size[0], size[1]))


def _lattice_points(like: Tensor, lattice: tuple[int, int], slope: Tensor, source: tuple[int, ...] | torch.Size, sign: int) -> Tensor:
    """Where the points of `lattice` fall, slice by slice, in slices of `source` cells shifted by k `slope`, in [-1, 1]."""
    count = like.shape[0]
    index = torch.arange(count, dtype=like.dtype, device=like.device)
    lines = []
    for cells, shift, size in zip(lattice, slope, source, strict=True):
        base = torch.clamp(shift, min=0) * (count - 1)
        offset = sign * (index * shift - base)
        position = offset[:, None] + torch.arange(cells, dtype=like.dtype, device=like.device)
        lines.append((2 * position + 1) / size - 1)
    rows, columns = lines
    grid = torch.stack(torch.broadcast_tensors(columns[:, None, :], rows[:, :, None]), -1)
    return grid.flatten(1, 2)
