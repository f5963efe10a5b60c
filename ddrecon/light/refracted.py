"""Parallel light that enters the box through its faces, and is refracted there (E5.8).

Through each face that it shines on goes a beam of its own, in the part of the box behind that face.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.grid import Grid, array_order
from ddrecon.light.lights import BeamLight, DirectionalLight
from ddrecon.light.profile import POINTS, mean_profile, seen_radius
from ddrecon.light.sky import Sky
from ddrecon.medium.optics import reflectance, refract
from ddrecon.numerics.remember import remember


@dataclass(frozen=True)
class RefractedBeam:
    """A `light` whose irradiance is `profile` [1, z, y, x] times as much in each cell.

    `face` is the array axis across which it has come in, and `at_face` [1, 1, ...] the profile in
    cells of that face, its axis having one cell; None where nothing refracts light.
    """

    light: DirectionalLight
    profile: Tensor
    face: int | None = None
    at_face: Tensor | None = None


def enter_faces(
    grid: Grid, index: float, light: DirectionalLight | BeamLight
) -> tuple[RefractedBeam, ...]:
    """What `light` becomes in the box of `grid`, one beam for each face that it falls on."""
    if isinstance(light, BeamLight):
        return _enter(grid, index, light.direction, light.power, light.position, light.radius)
    return _enter(grid, index, light.direction, light.irradiance)


@remember
def _enter(
    grid: Grid, index: float, direction: Tensor, power: Tensor, *beam: Tensor
) -> tuple[RefractedBeam, ...]:
    travel, entered_beams = normalize(array_order(direction), dim=0), list[RefractedBeam]()
    for axis in range(3):
        cosine = travel[axis].abs()
        if not cosine > 0:
            continue
        inside = refract(travel, torch.eye(3).to(travel)[axis], 1 / index)
        within = inside[axis].abs()
        entered = (1 - reflectance(within, index)) * cosine / within * power
        slope, centers, size = inside / inside[axis], grid.centers(travel), list(grid.spacing)
        face = (grid.lower if travel[axis] > 0 else grid.upper)[axis]
        profile = _behind(grid, centers, axis, slope, face)
        on_face = list(centers)
        on_face[axis], size[axis] = torch.full_like(centers[axis][:1, :1, :1], face), 0.0
        at_face = 1 + 0 * (on_face[0] + on_face[1] + on_face[2])
        if beam:
            position, radius = array_order(beam[0]), seen_radius(beam[1], max(grid.spacing))
            entry = array_order(position + (face - position[axis]) / travel[axis] * travel)
            refracted = entry, direction, radius, (axis, slope)
            profile = profile * mean_profile(centers, grid.spacing, *refracted)
            at_face = mean_profile(on_face, size, *refracted)
        light = DirectionalLight(array_order(inside), entered)
        entered_beams.append(RefractedBeam(light, profile[None], axis, at_face[None]))
    return tuple(entered_beams)


def _behind(grid: Grid, centers: list[Tensor], axis: int, slope: Tensor, face: float) -> Tensor:
    """The fraction of each cell [z, y, x] that light reaches through a `face` across `axis`.

    Behind the face light goes on by `slope` [3] for each unit along that axis.
    """
    total = slope.new_zeros(())
    for k in range(POINTS):
        depth = centers[axis] - face + grid.spacing[axis] * ((k + 0.5) / POINTS - 0.5)
        fraction = torch.ones_like(depth)
        for across in {0, 1, 2} - {axis}:
            entry, width = centers[across] - slope[across] * depth, grid.spacing[across]
            from_low = (entry - grid.lower[across]) / width + 0.5
            from_high = (entry - grid.upper[across]) / width + 0.5
            fraction = fraction * (from_low.clamp(0, 1) - from_high.clamp(0, 1))
        total = total + fraction
    return total / POINTS


def refract_skies(grid: Grid, index: float, skies: Sequence[Sky]) -> Iterator[tuple[Sky, Tensor]]:
    """The light of each region of `skies` behind each face it falls on, and its profile there."""
    for sky in skies:
        for travel, irradiance in zip(sky.travel, sky.irradiance, strict=True):
            light = DirectionalLight(array_order(travel), irradiance)
            for beam in enter_faces(grid, index, light):
                way, power = array_order(beam.light.direction)[None], beam.light.irradiance[None]
                yield Sky(way, power, way[..., None] * power[:, None]), beam.profile
