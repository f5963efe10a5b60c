"""Point lights: irradiance I tau / r^2, away from a position inside or outside the box.

Every cell is reached by a straight march through the field, from the light or from where its ray
enters the box, to where it enters the cell; within the cell the field is constant. Nearer than the
radius R of a sphere of one cell's volume, 1 / r^2 is bounded by its mean over that sphere around
the light, 3 / R^2, and the light's direction fades to none: all is finite, with finite derivatives,
also for a light in a cell's center.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid, array_order
from ddrecon.light.lights import PointLight
from ddrecon.light.moments import Moments, beam_moments
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.phase import henyey_greenstein, peaked_phase
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.interpolation import sample_volume
from ddrecon.numerics.nodes import Nodes

SMOOTH = 8
"""Order of the norm by which a ray's way through a cell is found: nearly the largest component,
without its kink where two are equal.
"""
CHUNK_SAMPLES = 1 << 20
"""Samples taken at a time on the way from the light to the cells."""


@dataclass(frozen=True)
class PointBeam:
    """A point light inside the volume: `mass` [K, z, y, x] is the integral of the extinction's
    field towards the light.

    `position` [3] is in array order, `irradiance` [C, 1, 1, 1] that at a distance of 1 u; squared
    distances count as at least `least`.
    """

    mass: Tensor
    position: Tensor
    irradiance: Tensor
    least: float

    def scattered(
        self, scattering: Tensor, nodes: Nodes, g: Tensor, peak: Tensor | None
    ) -> tuple[Tensor, Tensor | float]:
        """The integral over each segment of `scattering` [N, K, R] times p / r^2, `[N - 1, K or C,
        R]`, and a factor of 1.

        `peak`: as of `Beam.scattered`. Scattering times p is linear between nodes; 1 / r^2 over a
        segment is exactly the angle it subtends over the ray's distance.
        """
        offset = nodes.origin - self.position
        foot = (offset * nodes.direction).sum(-1)
        across = _square(offset - foot[:, None] * nodes.direction, self.least)
        along = foot + nodes.distance
        cosine = (-along / (across + along * along).sqrt())[:, None]
        phase = henyey_greenstein(cosine, g) if peak is None else peaked_phase(peak, cosine, g)
        apart = across.sqrt()
        angle = torch.atan2(apart * nodes.lengths, across + along[1:] * along[:-1])
        return nodes.integral(scattering * phase, angle / apart), 1.0


def follow_point_light(
    medium: Medium, light: PointLight, has_flux: bool
) -> tuple[PointBeam, Moments]:
    """The beam of `light`, and the moments of I tau / (4 pi r^2) averaged over each cell along the
    light's ray.
    """
    grid, extinction = medium.grid, medium.extinction
    position, irradiance, least = (
        array_order(light.position),
        light.intensity.view(-1, 1, 1, 1),
        _least_square(grid),
    )
    centers = torch.stack(torch.broadcast_tensors(*grid.centers(extinction.field)), -1)
    square = _square(centers - position, least)
    distance = square.sqrt()
    direction = (centers - position) / distance[..., None]
    speed = torch.linalg.vector_norm(
        direction / direction.new_tensor(grid.spacing), ord=SMOOTH, dim=-1
    )
    step = 1 / torch.maximum(speed, 0.5 / distance)
    entries = centers - 0.5 * step[..., None] * direction
    entered = _mass_to(
        extinction.field, grid, position, entries.flatten(0, 2), (distance - 0.5 * step).flatten()
    )
    mass = entered + 0.5 * step * extinction.field
    received = irradiance / (4 * math.pi) / square * extinction.mean_transmittance(entered, step)
    return PointBeam(mass, position, irradiance, least), beam_moments(
        received, direction.movedim(-1, 0), has_flux
    )


def _least_square(grid: Grid) -> float:
    """R^2 / 3, R being the radius of a sphere of one cell's volume."""
    return float((0.75 / math.pi * math.prod(grid.spacing)) ** (2 / 3) / 3)


def _square(offset: Tensor, least: float) -> Tensor:
    return (offset * offset).sum(-1).clamp(min=least)


def _mass_to(field: Tensor, grid: Grid, position: Tensor, ends: Tensor, distance: Tensor) -> Tensor:
    """The integral of `field` [K, z, y, x] from `position`, or the box, to `ends` [P, 3], which are
    `distance` [P] away.
    """
    pairs = math.ceil(math.hypot(*grid.extent) / (2 * min(grid.spacing)))
    part = _gauss_pairs(pairs).to(field)[:, None]

    def run(ends: Tensor, distance: Tensor) -> Tensor:
        offset = ends - position
        inside = _part_inside(grid, position, ends)
        points = ends - (inside * part)[..., None] * offset
        places = 2 * (points - points.new_tensor(grid.lower)) / points.new_tensor(grid.extent) - 1
        values = sample_volume(field, places.flip(-1))
        return values.mean(1) * (inside * distance)

    count = max(1, CHUNK_SAMPLES // (2 * pairs))
    chunks = zip(ends.split(count), distance.split(count), strict=True)
    return torch.cat([recompute(run, *chunk) for chunk in chunks], 1).unflatten(1, grid.shape)


def _gauss_pairs(count: int) -> Tensor:
    """The nodes of Gauss's two-point rule in `count` equal parts of [0, 1], `[2 count]`: they meet
    the planes of a grid only by accident.

    On such a plane, where interpolation has a kink, the derivative is that of one side.
    """
    middle, shift = torch.arange(count, dtype=torch.float64) + 0.5, 12**-0.5
    return torch.cat([middle - shift, middle + shift]) / count


def _part_inside(grid: Grid, position: Tensor, ends: Tensor) -> Tensor:
    """Which part of the way from `position` to each of `ends` [P, 3] lies inside the box: 1 for a
    light inside.
    """
    low, high = (position.new_tensor(corner) for corner in (grid.lower, grid.upper))
    is_below, is_above = position < low, position > high
    offset = torch.where(is_below | is_above, ends - position, 1.0)
    beyond = torch.where(is_below, ends - low, torch.where(is_above, ends - high, 1.0))
    return (beyond / offset).amin(-1)
