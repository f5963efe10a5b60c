"""The energy balance of a scene: what enters its box, what is absorbed there, what leaves (E5.3).

Scattered light leaves as one more sweep has it, in which nothing is lost; light not yet scattered
is followed to the middle of each cell at a face. Both are found apart from the fluence, by which
light is absorbed: what the sum lacks says how good all three are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.cameras import Rays
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.diffusion.rounds.characteristics import Course, radiance_along
from ddrecon.diffusion.rounds.sweep import cell_gradient, sweep_rule
from ddrecon.diffusion.rounds.transport import average_cells
from ddrecon.errors import UsageError
from ddrecon.grid import Grid, array_order
from ddrecon.light.lights import AmbientLight, BeamLight, DirectionalLight, PointLight
from ddrecon.light.moments import Moments
from ddrecon.light.pairs import TurnedBeam
from ddrecon.light.profile import mean_profile, seen_radius
from ddrecon.light.reduced import reduced_light
from ddrecon.light.sky import Sky, Source, decompose_lights
from ddrecon.march.emission import Emission
from ddrecon.march.integral import march
from ddrecon.march.sight import look_along
from ddrecon.medium.coefficients import Medium, keep_medium
from ddrecon.medium.remaining import has_backward_peak, remaining_moments
from ddrecon.numerics.remember import is_any_nonzero
from ddrecon.renderer import fluence_of, multiply_scatters, solve_light
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings

RAY_BY_RAY = RenderSettings(tolerance=0.0)


@dataclass(frozen=True)
class Balance:
    """Powers of each color [C]: what `enters` the box of each light, and what is `absorbed` there.

    And what leaves through each of `faces_of` [6, C], `unscattered` and `scattered`.
    """

    enters: dict[str, Tensor]
    absorbed: Tensor
    unscattered: Tensor
    scattered: Tensor

    @property
    def entered(self) -> Tensor:
        """All that enters [C]."""
        return reduce(torch.add, self.enters.values())

    @property
    def defect(self) -> Tensor:
        """The part of what enters that is neither absorbed nor leaves [C]."""
        left = (self.unscattered + self.scattered).sum(0)
        return 1 - (self.absorbed + left) / self.entered


@dataclass(frozen=True)
class Face:
    """A face of the box of `grid` across `axis`, on the lower or the upper `side` (0 or 1)."""

    grid: Grid
    axis: int
    side: int

    @property
    def area(self) -> float:
        """That of one of its cells [u^2]."""
        return math.prod(self.grid.spacing) / self.grid.spacing[self.axis]

    def centers(self, like: Tensor) -> list[Tensor]:
        """The middles of its cells, as of `Grid.centers`."""
        lines, ends = self.grid.centers(like), (self.grid.lower, self.grid.upper)
        lines[self.axis] = like.new_full((1, 1, 1), ends[self.side][self.axis])
        return lines

    def outward(self, travel: Tensor) -> Tensor:
        """The part of the irradiance along unit `travel` [..., 3] that leaves through it."""
        return (travel[..., self.axis] * (2 * self.side - 1)).clamp(min=0)

    def layer(self, field: Tensor) -> Tensor:
        """The cells of `field` [C, z, y, x] at this face."""
        return field.select(1 + self.axis, -self.side)


def faces_of(grid: Grid) -> list[Face]:
    """The faces of the box: -z, +z, -y, +y, -x, +x."""
    return [Face(grid, axis, side) for axis in range(3) for side in range(2)]


@torch.no_grad()
def find_balance(scene: Scene) -> Balance:
    """The energy balance of `scene`.

    Raises UsageError where no light enters, or where nobody follows light that is scattered.
    """
    light_field = solve_light(scene, SolveMemory())
    medium, angles = light_field.medium, scene.diffusion.angles
    is_followed = multiply_scatters(medium, scene.diffusion)
    if not is_followed and is_any_nonzero(medium.scattering.scale):
        raise UsageError("diffusion.model: none follows no light that is scattered: take p1")
    # Of light that a forward peak has scattered the light field says that it was not (E8.4).
    media = medium, keep_medium(scene.volume)
    sources, enters, through = list[Source](), dict[str, Tensor](), list[Tensor]()
    for number, light in enumerate(scene.lights):
        parts = decompose_lights([light])
        crossing = reduce(torch.add, (_cross_box(part, media, angles) for part in parts))
        enters[f"lights.{number}"] = crossing[:, 0].sum(0)
        through.append(crossing[:, 1:])
        sources += parts
    if not any(bool((power > 0).any()) for power in enters.values()):
        raise UsageError("lights: none enters the volume, so there is nothing to balance")
    passing, unscattered = reduce(torch.add, through).unbind(1)
    reduced = reduced_light(medium, sources, medium.degree, has_backward_peak(medium))
    factors = remaining_moments(medium)[: medium.degree + 1]
    source = light_field.diffuse.weighted(factors).plus(reduced.source)
    rise = cell_gradient(light_field.diffuse.mean + reduced.source.mean)
    scattered = passing - unscattered + _sweep_out(medium, source, rise, None, angles)
    for beam in light_field.turned:
        scattered = scattered + _leave_turned(beam, medium.grid)
    lost = medium.absorption.value * fluence_of(light_field)
    absorbed = math.prod(medium.grid.spacing) * lost.sum((1, 2, 3), dtype=torch.float64)
    return Balance(enters, absorbed, unscattered, scattered)


def _cross_box(part: Source, media: Sequence[Medium], angles: int) -> Tensor:
    """The power of `part` of a light that leaves by each face, [6, 1 + media, C].

    First what would if the box were empty, then what does unscattered with each of the `media`.
    """
    grid = media[0].grid
    if isinstance(part, AmbientLight):
        areas = [grid.cells * math.prod(grid.spacing) / grid.extent[f.axis] for f in faces_of(grid)]
        empty = math.pi * torch.outer(part.radiance.new_tensor(areas), part.radiance).double()
        nothing = torch.zeros_like(media[0].extinction.value)
        given = Moments(nothing), cell_gradient(nothing), part.radiance.view(-1, 1, 1, 1), angles
        found = [empty, *(empty + _sweep_out(medium, *given) for medium in media)]
        return torch.stack(torch.broadcast_tensors(*found), 1)
    beams: Sequence[DirectionalLight | PointLight | BeamLight]
    if isinstance(part, Sky):
        each = zip(part.travel, part.irradiance, strict=True)
        beams = [DirectionalLight(array_order(travel), power) for travel, power in each]
    else:
        beams = [part]
    faces = faces_of(grid)
    each_beam = (torch.stack([_cross_face(beam, media, face) for face in faces]) for beam in beams)
    return reduce(torch.add, each_beam)


def _cross_face(
    light: DirectionalLight | PointLight | BeamLight, media: Sequence[Medium], face: Face
) -> Tensor:
    """The same of one beam by one face [1 + media, C], along rays to the middles of its cells."""
    grid, field = media[0].grid, media[0].extinction.field
    lines = face.centers(field)
    points = torch.stack(torch.broadcast_tensors(*lines), -1).flatten(0, 2)
    if isinstance(light, PointLight):
        eye = array_order(light.position)
        distance = torch.linalg.vector_norm(points - eye, dim=1, keepdim=True)
        rays = Rays(eye.expand_as(points), (points - eye) / distance, eye)
        irradiance = light.intensity[:, None] / distance[:, 0] ** 2
    else:
        travel = normalize(array_order(light.direction), dim=0).expand_as(points)
        rays = Rays(points - 2 * math.hypot(*grid.extent) * travel, travel, None)
        if isinstance(light, BeamLight):
            z, y, x = (0.0 if axis == face.axis else h for axis, h in enumerate(grid.spacing))
            beam = light.position, light.direction, seen_radius(light.radius, grid)
            irradiance = light.power[:, None] * mean_profile(lines, (z, y, x), *beam).flatten()
        else:
            irradiance = light.irradiance[:, None]
    leaving = face.area * irradiance * face.outward(rays.direction)
    colors = max(len(leaving), *(len(medium.extinction.scale) for medium in media))
    if not bool(leaving.any()):
        return leaving.new_zeros(1 + len(media), colors, dtype=torch.float64)
    powers, sight = [leaving.expand(colors, -1)], look_along(grid, rays, RAY_BY_RAY)
    for medium in media:
        dark = torch.zeros_like(field[:1])
        given = medium.extinction, medium.scattering, (), dark, medium.seen, None
        seen = march(Emission(grid, *given), sight, RAY_BY_RAY, torch.ones_like(leaving[:1]))
        powers.append(seen * leaving)
    return torch.stack(powers).sum(2, dtype=torch.float64)


def _sweep_out(
    medium: Medium, source: Moments, rise: Tensor, inflow: Tensor | None, angles: int
) -> Tensor:
    """The power [6, C] that leaves by each face, in one sweep, of light that `source` scatters.

    `rise` is `cell_gradient` of what scatters. With `inflow` it is less what that would be in an
    empty box.
    """
    grid, moments, cells = medium.grid, source.harmonics(medium.degree), average_cells(medium)
    directions, weights, values = sweep_rule(angles, len(moments))
    power = moments.new_zeros(6, 1, dtype=torch.float64)
    for direction, weight, row in zip(directions, weights, values.to(moments), strict=True):
        scatters = torch.tensordot(row, moments, 1)
        _, leaving = radiance_along(cells, scatters, rise, inflow, direction)
        course, left = Course.of(grid, direction), leaving.clone()
        gone = leaving.new_zeros(6, len(leaving), dtype=torch.float64)
        # What leaves a cell goes on to the next slice, or beyond it, and there beyond other faces.
        for axis in sorted(range(3), key=lambda axis: -abs(course.moved[axis])):
            face, part = Face(grid, axis, int(course.moved[axis] > 0)), abs(course.moved[axis])
            beyond = part * face.layer(left)
            face.layer(left).sub_(beyond)
            gone[2 * axis + face.side] = beyond.sum((1, 2))
        power = power + 4 * math.pi * weight * math.prod(grid.spacing) / course.step * gone
    return power


def _leave_turned(beam: TurnedBeam, grid: Grid) -> Tensor:
    """The power [6, C] of a beam that a backward peak has turned (E8.11).

    Irradiance on a face is on the line through the two outermost cells.
    """
    powers = []
    for face in faces_of(grid):
        inner = min(1, grid.shape[face.axis] - 1)
        last = face.layer(beam.radiance)
        before = beam.radiance.select(1 + face.axis, -1 - inner if face.side else inner)
        on_face = (1.5 * last - 0.5 * before).clamp(min=0).sum((1, 2), dtype=torch.float64)
        powers.append(4 * math.pi * face.area * face.outward(beam.direction) * on_face)
    return torch.stack(powers)


def describe(balance: Balance) -> dict[str, Any]:
    """The balance as plain values: powers, and `fractions` of all that enters.

    Of one color each is a number, else a list of three.
    """

    def plain(values: Tensor) -> float | list[float]:
        numbers: list[float] = values.tolist()
        return numbers[0] if len(numbers) == 1 else numbers

    def in_units(unit: Tensor) -> dict[str, Any]:
        return {
            "entered": plain(balance.entered / unit),
            "enters": {name: plain(power / unit) for name, power in balance.enters.items()},
            "absorbed": plain(balance.absorbed / unit),
            "leaves": {
                f"{sign}{axis}": {
                    "unscattered": plain(balance.unscattered[place] / unit),
                    "scattered": plain(balance.scattered[place] / unit),
                }
                for axis, first in zip("xyz", (4, 2, 0), strict=True)
                for sign, place in (("-", first), ("+", first + 1))
            },
        }

    powers, fractions = in_units(torch.ones_like(balance.entered)), in_units(balance.entered)
    return {**powers, "fractions": fractions, "defect_percent": plain(100 * balance.defect)}


def lines(report: dict[str, Any]) -> list[str]:
    """The report of `describe` as lines of text."""

    def text(*keys: str) -> str:
        power, part = (
            reduce(dict.__getitem__, keys, which) for which in (report, report["fractions"])
        )
        return f"{_listed(power, '.4g')} ({_listed(part, '.2%')})"

    return [
        *(f"enters by {name}: {text('enters', name)}" for name in report["enters"]),
        f"absorbed: {text('absorbed')}",
        *(
            f"leaves by {face}: unscattered {text('leaves', face, 'unscattered')}, "
            f"scattered {text('leaves', face, 'scattered')}"
            for face in report["leaves"]
        ),
        f"neither absorbed nor left: {_listed(report['defect_percent'], '.2g')} %",
    ]


def _listed(value: Any, form: str) -> str:
    return ", ".join(format(one, form) for one in (value if isinstance(value, list) else [value]))
