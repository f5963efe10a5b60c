"""Light that is not the same in all of the box: Gaussian beams (docs/theory.md E5.5), and parallel
light that enters through faces, and is refracted there (E5.8).

Cells have the mean of a beam's irradiance, so that all of them together receive its power, wherever
the axis runs. No beam is much thinner than a cell: what depends on its place stays smooth. Through
each face that light shines on goes a beam of its own, in the part of the box behind that face.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.grid import Grid, array_order
from ddrecon.light.lights import BeamLight, DirectionalLight
from ddrecon.light.sky import Sky
from ddrecon.medium.optics import reflectance, refract
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.remember import remember

THINNEST = 0.5
"""A pencil's radius, as a part of a cell's longest side; no beam is thinner."""
POINTS = 4
"""Points along each side of a cell over which its mean is taken. Those of all cells add up to the
power of a pencil within 1e-8.
"""
NORM_ORDER = 8
"""Order of the norm of a beam's radius and a pencil's: nearly the larger, without a kink."""


def seen_radius(radius: Tensor, width: float | Tensor) -> Tensor:
    """The radius [u] that a beam of `radius` has among cells of `width`."""
    thinnest = torch.as_tensor(THINNEST * width, dtype=radius.dtype, device=radius.device)
    radii = torch.stack(torch.broadcast_tensors(radius, thinnest))
    return torch.linalg.vector_norm(radii, ord=NORM_ORDER, dim=0)


@remember
def profile_in(grid: Grid, position: Tensor, direction: Tensor, radius: Tensor) -> Tensor:
    """The irradiance of a beam in each cell over its power, [1, z, y, x] [1/u^2]."""
    beam = position, direction, seen_radius(radius, max(grid.spacing))
    return mean_profile(grid.centers(position), grid.spacing, *beam)[None]


def mean_profile(
    centers: Sequence[Tensor],
    size: Sequence[float],
    position: Tensor,
    direction: Tensor,
    radius: Tensor,
    inside: tuple[int, Tensor] | None = None,
) -> Tensor:
    """The mean of E5.5 over boxes of `size` around `centers` (along z, y, x), [z, y, x].

    `radius` may differ from box to box. A refracted beam met a face at `position`; `inside` are the
    axis across that face, and how far it goes [3] for each unit along that axis.
    """
    travel = normalize(array_order(direction), dim=0)
    offset = [c - p for c, p in zip(centers, array_order(position), strict=True)]
    if inside is not None:
        axis, slope = inside
        offset = [o - s * offset[axis] for o, s in zip(offset, slope, strict=True)]
    along = sum(o * d for o, d in zip(offset, travel, strict=True))
    square = sum((o - along * d) ** 2 for o, d in zip(offset, travel, strict=True))

    def sample(shift: Tensor) -> Tensor:
        if inside is not None:
            shift = shift - slope * shift[axis]
        # |across + shift|^2, which is linear in the offset but for that of the center
        across = shift - (shift @ travel) * travel
        more = sum(2 * o * s for o, s in zip(offset, across, strict=True))
        return torch.exp(-2 / radius**2 * (square + (more + across @ across)))

    middles = [(k + 0.5) / POINTS - 0.5 for k in range(POINTS)]
    shifts = [*product(*([h * middle for middle in middles] if h else [0.0] for h in size))]
    total = reduce(torch.add, (recompute(sample, radius.new_tensor(shift)) for shift in shifts))
    return total * (2 / (math.pi * len(shifts))) / radius**2


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
