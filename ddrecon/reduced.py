"""Light not yet scattered: how much of it reaches each cell, and its moments Q0 and Q1 (docs/theory.md section 1).

A beam is followed by three vectorized operations on slices: shear the grid until the light runs along an axis, sum cumulatively
along that axis, shear back. Density and optical depth are interpolated, never their exponentials.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.autodiff import is_varied, recomputed
from ddrecon.grid import Grid, array_order
from ddrecon.lights import AmbientLight, DirectionalLight, PointLight
from ddrecon.medium import Medium
from ddrecon.moments import Moments, Vector, beam_moments
from ddrecon.nodes import Nodes
from ddrecon.phase import henyey_greenstein, peaked_phase_along
from ddrecon.point_light import PointBeam, point_beam
from ddrecon.quadrature import sphere_quadrature
from ddrecon.running import running_sum
from ddrecon.sampling import Smooth
from ddrecon.separable import Weights, sample_lattice
from ddrecon.sky import Sky, Source


@dataclass(frozen=True)
class Beam:
    """A directional light inside the volume: `mass` [K, z, y, x] is the integral of the extinction's field towards the light.

    `direction` [3] is its unit direction of travel in array order, `irradiance` [C, 1, 1, 1].
    """

    mass: Tensor
    direction: Tensor
    irradiance: Tensor

    def scattered(self, scattering: Tensor, nodes: Nodes, g: Tensor, peak: Tensor | None) -> tuple[Tensor, Tensor | float]:
        """The integral over each segment of `scattering` [N, K, R], and the phase function p, the same all along a ray.

        With a forward peak of depth `peak` [N, C, R] at the nodes p changes on the way: the integral holds it, and the factor is 1.
        """
        cosine = -(nodes.direction @ self.direction)
        if peak is None:
            return nodes.integral(scattering), henyey_greenstein(cosine, g)
        return nodes.integral(scattering * peaked_phase_along(peak, cosine, g)), 1.0


@dataclass(frozen=True)
class ReducedLight:
    """Light of directional and point lights not yet scattered: `beams`, and their `source` Q0, Q1 averaged over cells (no Q1 for g = 0)."""

    beams: tuple[Beam | PointBeam, ...]
    source: Moments


def reduced_light(medium: Medium, lights: Sequence[Source], has_flux: bool) -> ReducedLight:
    """The light of directional and point `lights` that reaches each cell unscattered; `has_flux`: whether Q1 is needed (g is not 0)."""
    beams: list[Beam | PointBeam] = []
    total = Moments(torch.zeros_like(medium.extinction.value))
    for light in lights:
        if isinstance(light, DirectionalLight | PointLight):
            beam, received = _beam(medium, light, has_flux) if isinstance(light, DirectionalLight) else point_beam(medium, light, has_flux)
            beams.append(beam)
            total = total.plus(received)
    return ReducedLight(tuple(beams), total.scaled(1.0, 3 * medium.mean_cosine))


def ambient_radiance(lights: Sequence[object], like: Tensor) -> Tensor:
    """The radiance `[C, 1, 1, 1]` that all ambient `lights` together send in from every direction."""
    radiances = [light.radiance for light in lights if isinstance(light, AmbientLight)]
    return torch.stack(torch.broadcast_tensors(*radiances, like.new_zeros(1))).sum(0).view(-1, 1, 1, 1)


def ambient_sky(radiance: Tensor) -> Sky:
    """Ambient light of `radiance` [C, 1, 1, 1] as light from the directions of a quadrature over the sphere."""
    directions, weights = sphere_quadrature(radiance)
    irradiance = 4 * math.pi * weights[:, None] * radiance.flatten()
    return Sky(directions, irradiance, directions[..., None] * irradiance[:, None])


def unscattered_sky(medium: Medium, lights: Sequence[object], has_flux: bool) -> Moments:
    """Light of all skies in `lights` not yet scattered, to first order in angle: int L_ri and 3 int L_ri w over the sphere, over 4 pi.

    One direction at a time, so that memory does not grow with their number.
    """
    total = Moments(torch.zeros_like(medium.extinction.value))
    for sky in _lit_skies(lights):
        vectors = sky.vector if has_flux else [None] * len(sky.travel)
        for travel, irradiance, vector in zip(sky.travel, sky.irradiance, vectors, strict=True):
            total = total.plus(recomputed(_seen_from, medium, travel, irradiance, vector))
    return total.scaled(1 / (4 * math.pi), 3 / (4 * math.pi))


def scattered_sky(medium: Medium, skies: Sequence[Sky], towards: Vector) -> Tensor:
    """What one scattering turns `towards` a camera (unit, its components broadcast to cells) of the light of `skies`, `[C, z, y, x]`.

    Per unit length and kappa_s, by the exact phase function: sum of p E tau / (4 pi), one direction at a time.
    """
    total = torch.zeros_like(medium.extinction.value)
    for sky in _lit_skies(skies):
        for travel, irradiance in zip(sky.travel, sky.irradiance, strict=True):
            total = total + recomputed(_turned_towards, medium, travel, irradiance, towards)
    return total / (4 * math.pi)


def _lit_skies(lights: Sequence[object]) -> list[Sky]:
    """The skies that differ from their mean, or may come to do so because they are being varied."""
    skies = [light for light in lights if isinstance(light, Sky)]
    return [sky for sky in skies if is_varied(sky.irradiance) or bool((sky.irradiance.detach() != 0).any())]


def _turned_towards(medium: Medium, travel: Tensor, irradiance: Tensor, towards: Vector) -> Tensor:
    visible = _seen_from(medium, travel, irradiance, None).mean
    z, y, x = (component * cosine for component, cosine in zip(travel, towards, strict=True))
    return visible * henyey_greenstein(z + y + x, medium.g)


def _seen_from(medium: Medium, direction: Tensor, irradiance: Tensor, vector: Tensor | None) -> Moments:
    """`irradiance` ([C] or scalar) and `vector` [3, C], each times the transmittance along `direction`, averaged over cells."""
    visible = medium.extinction.mean_transmittance(
        *entered_mass(medium.extinction.field, medium.grid, direction, medium.extinction.mass_bound)
    )
    mean = visible * irradiance.view(-1, 1, 1, 1)
    if vector is None:
        return Moments(mean)
    z, y, x = (visible * component.view(-1, 1, 1, 1) for component in vector)
    return Moments(mean, (z, y, x))


def _beam(medium: Medium, light: DirectionalLight, has_flux: bool) -> tuple[Beam, Moments]:
    """The beam of `light`, and the moments of E tau / (4 pi) averaged over each cell along the beam."""
    direction = array_order(torch.nn.functional.normalize(light.direction, dim=0))
    irradiance = light.irradiance.view(-1, 1, 1, 1)
    entered, step = recomputed(entered_mass, medium.extinction.field, medium.grid, direction, medium.extinction.mass_bound)
    received = irradiance / (4 * math.pi) * recomputed(medium.extinction.mean_transmittance, entered, step)
    beam = Beam(entered + 0.5 * step * medium.extinction.field, direction, irradiance)
    return beam, beam_moments(received, direction, has_flux)


def entered_mass(field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
    """The integral of `field` from the box to where a beam enters each cell's slice, and its path length within a slice [u].

    `field`: [K, z, y, x]; `direction`: [3], unit, array order, the way light travels. Slices are those across the axis along
    which the beam crosses most cells. Outside the box the field falls to zero within half a cell, which keeps the mass of the
    outer half cells. The sum over slices is exact for light along an axis; for slanted light it is refined by planes between them, and
    carried back to cells to third order, by corrections bounded by 1 / `bound`. Returns `[K, z, y, x]` and a scalar.
    """
    if field.shape[0] == 1:
        return _entered_mass(field, grid, direction, bound)
    each = [recomputed(_entered_mass, one, grid, direction, bound) for one in field.split(1)]
    return torch.cat([entered for entered, _ in each]), each[0][1]


def _entered_mass(field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float) -> tuple[Tensor, Tensor]:
    """What `entered_mass` returns, of one field [1, z, y, x]."""
    speed = direction / direction.new_tensor(grid.spacing)
    axis = int(speed.detach().abs().argmax())
    order = [axis + 1, 0] + [1 + other for other in range(3) if other != axis]
    slices = field.permute(order)
    is_reversed = bool(direction[axis] < 0)
    if is_reversed:
        slices = slices.flip(0)
    slope = torch.stack([speed[other] for other in range(3) if other != axis]) / speed[axis].abs()
    step = grid.spacing[axis] / direction[axis].abs()
    shear = _Shear.of(slices, slope)
    centers, middles = shear.there(slices, 0.0), shear.there(0.5 * (slices[1:] + slices[:-1]), 0.5)
    bends = middles - 0.5 * (centers[1:] + centers[:-1])
    finer = running_sum(torch.cat([torch.zeros_like(centers[:1]), bends])) * (0.5 * step)
    smooth = Smooth(0, 1, bound)
    entered = shear.back((running_sum(centers) - centers) * step + smooth.bounded(finer), smooth)
    if is_reversed:
        entered = entered.flip(0)
    return entered.permute([order.index(dim) for dim in range(4)]), step


@dataclass(frozen=True)
class _Shear:
    """Slices of `size` cells on a `lattice` that holds all of them, slice k shifted by -k `slope` cells, slice 0 beginning at `first`."""

    slope: Tensor
    size: tuple[int, int]
    lattice: tuple[int, int]
    first: tuple[int, int]

    @staticmethod
    def of(slices: Tensor, slope: Tensor) -> _Shear:
        """That of `slices` [N, K, H, W]."""
        height, width = slices.shape[2:]
        rows, columns = (math.floor(abs(s) * (slices.shape[0] - 1) + 1e-9) + 1 for s in slope.tolist())
        is_on = [s > 0 for s in slope.tolist()]
        return _Shear(slope, (height, width), (height + rows, width + columns), (rows * is_on[0], columns * is_on[1]))

    def there(self, slices: Tensor, shift: float) -> Tensor:
        """`slices` [N, K, H, W], numbered from `shift`, on the lattice; they fall to zero one cell beyond their outermost centers."""
        places = self._places(slices, shift, self.lattice, self.size, 1)
        rows, columns = (Weights.at(place, size, fades=True) for place, size in zip(places, self.size, strict=True))
        return sample_lattice(slices, rows, columns).unflatten(-1, self.lattice)

    def back(self, sheared: Tensor, smooth: Smooth) -> Tensor:
        """Slices of values `sheared` on the lattice, in cells again."""
        places = self._places(sheared, 0.0, self.size, self.lattice, -1)
        rows, columns = (Weights.at(place, size, is_smooth=True) for place, size in zip(places, self.lattice, strict=True))
        return sample_lattice(sheared, rows, columns, smooth).unflatten(-1, self.size)

    def _places(self, like: Tensor, shift: float, points: tuple[int, int], cells: tuple[int, int], sign: int) -> list[Tensor]:
        """Where rows and columns of `points` fall among those of `cells`, slice by slice, in [-1, 1]."""
        index = torch.arange(like.shape[0], dtype=like.dtype, device=like.device) + shift
        lines = []
        for slope, first, count, size in zip(self.slope, self.first, points, cells, strict=True):
            drift = sign * (index * slope - first)
            position = drift[:, None] + torch.arange(count, dtype=like.dtype, device=like.device)
            lines.append((2 * position + 1) / size - 1)
        return lines
