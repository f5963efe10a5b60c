"""Point lights, inside or outside the box.

At x, seen from the light at p, the irradiance and the direction of travel are

    I tau / s,    (x - p) / sqrt(s),    s = max(|x - p|^2, R^2 / 3),

where R is the radius of a sphere of one cell's volume: the mean of 1 / r^2 over such a sphere
around the light is 3 / R^2. So all is finite, with finite derivatives, in its own cell as well.

Light goes straight through the field to where it enters a cell; in that the field is constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid, array_order
from ddrecon.light.lights import PointLight
from ddrecon.light.moments import beam_moments
from ddrecon.medium.coefficients import Medium, along_colors
from ddrecon.medium.phase import SeenPhase
from ddrecon.numerics.autodiff import is_fused, recompute
from ddrecon.numerics.decay import Nodes
from ddrecon.numerics.interpolation import sample_volume

NORM_ORDER = 8
"""Order of the norm that gives a ray's path through a cell: nearly the largest component, without
its kink where two are equal.
"""
CHUNK_SAMPLES = 1 << 20
"""Samples taken at a time on the way from the light to the cells."""


@dataclass(frozen=True)
class PointBeam:
    """A point light inside the volume.

    `mass` [K, z, y, x]: the integral of the extinction's field from the light to cells' centers;
    `position` [3]: in array order; `irradiance` [C, 1, 1, 1]: at a distance of 1 u; `least_square`
    [u^2]: R^2 / 3, the least that squared distances count as.
    """

    mass: Tensor
    position: Tensor
    irradiance: Tensor
    least_square: float

    def scatter(
        self, scattering: Tensor, nodes: Nodes, seen: SeenPhase, peak: Tensor | None
    ) -> Tensor:
        """The integral of `scattering` p / r^2 over each segment, `[N - 1, K or C, R]`.

        Arguments as of `Beam.scatter`. Scattering times p is linear between nodes.
        """
        foot, across = self.passing(nodes.origin, nodes.direction)
        along = foot + nodes.distance

        # The phase function at the nodes, of the angle between light and view ray.
        phase = seen.at_angles(peak, torch.atan2(across.sqrt().expand_as(along), -along))

        # The integral of 1 / r^2 over a segment is the angle it subtends at the light, over the
        # ray's distance from it: int ds / (d^2 + s^2) = atan(s / d) / d.
        distance = across.sqrt()
        angle = torch.atan2(distance * nodes.lengths, across + along[1:] * along[:-1])
        return nodes.integral(scattering * phase, angle / distance)

    def passing(self, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """How view rays from `origin` along unit `direction` [R, 3] pass the light.

        The way [R] [u] to the origin from where a ray is nearest to the light, and the square [R]
        [u^2] of its distance there, bounded as all are.
        """
        offset = origin - self.position
        foot = (offset * direction).sum(-1)
        return foot, _bounded_square(offset - foot[:, None] * direction, self.least_square)


def follow_point_light(medium: Medium, light: PointLight) -> PointBeam:
    """The beam of `light` in `medium`."""
    irradiance, position = along_colors(light.intensity), array_order(light.position)
    entered, step, _, _ = _go_to_cells(medium, position)
    mass = entered + 0.5 * step * medium.extinction.field
    return PointBeam(mass, position, irradiance, _least_square(medium.grid))


def receive_point_light(cells: Medium, light: PointLight, degree: int) -> Tensor:
    """The moments phi of I tau / (4 pi r^2) at `cells` (E2.2).

    They go up to `degree`, and are those of radiance that all travels away from the light. tau is
    averaged over each cell along the light's ray.
    """
    entered, step, square, direction = _go_to_cells(cells, array_order(light.position))
    tau = cells.extinction.mean_transmittance(entered, step)
    received = along_colors(light.intensity) / (4 * math.pi) / square * tau
    return beam_moments(received, direction, degree)


def _least_square(grid: Grid) -> float:
    return float((0.75 / math.pi * math.prod(grid.spacing)) ** (2 / 3) / 3)


def _go_to_cells(medium: Medium, position: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The mass from `position` to where its light enters each cell, the path through that [u], the
    squared distance to the center [u^2], and the direction there [z, y, x, 3].
    """
    grid, extinction = medium.grid, medium.extinction

    # s, sqrt(s) and the direction of travel, as in the module's docstring.
    centers = torch.stack(torch.broadcast_tensors(*grid.centers(extinction.field)), -1)
    square = _bounded_square(centers - position, _least_square(grid))
    distance = square.sqrt()
    direction = (centers - position) / distance[..., None]

    # The path through a cell is one over the largest speed [cells/u] along an axis, as for beams.
    # Half of it is at most the distance: no ray begins behind its light.
    cells = direction / direction.new_tensor(grid.spacing)
    speed = torch.linalg.vector_norm(cells, ord=NORM_ORDER, dim=-1)
    step = 1 / torch.maximum(speed, 0.5 / distance)

    # Mass from the light to where the ray enters the cell, and from there to the center.
    entries = (centers - 0.5 * step[..., None] * direction).flatten(0, 2)
    lengths = (distance - 0.5 * step).flatten()
    entered = _mass_to(extinction.field, grid, position, entries, lengths)
    return entered.unflatten(1, grid.shape), step, square, direction


def _bounded_square(offset: Tensor, least: float) -> Tensor:
    """The squared length of `offset` [..., 3], or `least` where that is more."""
    return (offset * offset).sum(-1).clamp(min=least)


def _mass_to(field: Tensor, grid: Grid, position: Tensor, ends: Tensor, distance: Tensor) -> Tensor:
    """The integral of `field` [K, z, y, x] from `position` to `ends` [P, 3]; 0 outside the box.

    `distance` [P]: how far `ends` are from `position`. Returns `[K, P]`.
    """
    pairs = math.ceil(math.hypot(*grid.extent) / (2 * min(grid.spacing)))
    # Gauss's two-point rule meets a grid's planes, where interpolation has a kink, by accident.
    middle, shift = torch.arange(pairs, dtype=torch.float64) + 0.5, 12**-0.5
    fraction = (torch.cat([middle - shift, middle + shift]) / pairs).to(field)[:, None]
    inside = _part_inside(grid, position, ends)
    ways = ends - inside[:, None] * (ends - position), ends, inside * distance
    if is_fused(position) and not position.requires_grad:
        from ddrecon.light.fused.point_light import integrate_ways

        return integrate_ways(field, grid, *ways, fraction)

    def integrate(begins: Tensor, ends: Tensor, lengths: Tensor) -> Tensor:
        points = ends - fraction[..., None] * (ends - begins)
        places = 2 * (points - points.new_tensor(grid.lower)) / points.new_tensor(grid.extent) - 1
        return sample_volume(field, places.flip(-1)).mean(1) * lengths

    chunks = (way.split(max(1, CHUNK_SAMPLES // (2 * pairs))) for way in ways)
    return torch.cat([recompute(integrate, *chunk) for chunk in zip(*chunks, strict=True)], 1)


def _part_inside(grid: Grid, position: Tensor, ends: Tensor) -> Tensor:
    """The fraction [P] of the way from `position` to `ends` [P, 3] that lies in the box.

    Along each axis on which the light is outside, the way enters at the face on the light's side:
    of `offset`, what lies `beyond` that face is inside.
    """
    low, high = (position.new_tensor(corner) for corner in (grid.lower, grid.upper))
    is_below, is_above = position < low, position > high
    offset = torch.where(is_below | is_above, ends - position, 1.0)
    beyond = torch.where(is_below, ends - low, torch.where(is_above, ends - high, 1.0))
    return (beyond / offset).amin(-1)
