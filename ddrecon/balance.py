"""The energy balance of a scene: what enters its box, what is absorbed there, what leaves (E5.7).

Scattered light leaves as one more sweep has it, in which nothing is lost; light not yet scattered
is followed to the middle of each cell at a face. Both are found apart from the fluence, by which
light is absorbed: what the sum lacks says how good all three are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from itertools import product
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ddrecon.cameras import Rays
from ddrecon.diffusion.cells import average_cells
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.diffusion.rounds.characteristics import Course, radiance_along
from ddrecon.diffusion.rounds.sweep import cell_gradient, sweep_rule
from ddrecon.errors import UsageError
from ddrecon.grid import Grid, array_order
from ddrecon.light.lights import AmbientLight, BeamLight, DirectionalLight, PointLight
from ddrecon.light.moments import Moments
from ddrecon.light.pairs import TurnedBeam
from ddrecon.light.profile import mean_profile, seen_radius
from ddrecon.light.sky import Sky, Source, decompose_lights
from ddrecon.march.integral import march
from ddrecon.march.periods import absorb
from ddrecon.march.sight import look_along
from ddrecon.medium.coefficients import Medium, keep_medium
from ddrecon.medium.remaining import remaining_moments
from ddrecon.numerics.remember import is_any_nonzero
from ddrecon.renderer import fluence_of, multiply_scatters, solve_light
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings

FACES = "-z", "+z", "-y", "+y", "-x", "+x"
"""Of the box, in array order."""
Beamed = DirectionalLight | PointLight | BeamLight
RAY_BY_RAY = RenderSettings(tolerance=0.0)


@torch.no_grad()
def find_balance(scene: Scene) -> dict[str, Any]:
    """What power `enters` the box of `scene` of each light, is `absorbed` there, and `leaves`.

    By each face, as unscattered and as scattered light. `fractions` are the same of all that
    enters; `defect_percent` is what enters and neither is absorbed nor leaves. Of one color each is
    a number, else a list of three. Raises UsageError where no light enters, or where nobody follows
    light that is scattered.
    """
    if scene.volume.grid.periodic:
        raise UsageError("volume.periodic: of a volume that repeats there is no balance")
    light_field = solve_light(scene, SolveMemory())
    medium, angles = light_field.medium, scene.diffusion.angles
    if is_any_nonzero(medium.scattering.scale) and not multiply_scatters(medium, scene.diffusion):
        raise UsageError("diffusion.model: none follows no light that is scattered: take p1")
    # Of light that a forward peak has scattered the light field says that it was not (E8.4).
    media = medium, keep_medium(scene.volume)
    enters, leaves = dict[str, Tensor](), list[Tensor]()
    for number, light in enumerate(scene.lights):
        parts = decompose_lights([light])
        crossing = reduce(torch.add, (_cross_box(part, media, angles) for part in parts))
        enters[f"lights.{number}"] = crossing[0].sum(0)
        leaves.append(crossing[1:])
    if not any(bool((power > 0).any()) for power in enters.values()):
        raise UsageError("lights: none enters the volume, so there is nothing to balance")
    passing, unscattered = reduce(torch.add, leaves)
    factors = remaining_moments(medium)[: medium.degree + 1]
    received = light_field.received.source
    source = light_field.diffuse.weighted(factors).plus(received)
    rise = cell_gradient(light_field.diffuse.mean + received.mean)
    scattered = passing - unscattered + _sweep_out(medium, source, rise, None, angles)
    for beam in light_field.turned:
        scattered = scattered + _leave_turned(beam, medium.grid)
    lost = average_cells(medium).absorption.value * fluence_of(light_field)
    absorbed = math.prod(medium.grid.spacing) * lost.sum((1, 2, 3), dtype=torch.float64)
    entered = reduce(torch.add, enters.values())
    left = absorbed + (unscattered + scattered).sum(0)

    def in_units(unit: Tensor) -> dict[str, Any]:
        parts = zip(FACES, unscattered / unit, scattered / unit, strict=True)
        return {
            "enters": {name: _plain(power / unit) for name, power in enters.items()},
            "absorbed": _plain(absorbed / unit),
            "leaves": {f: {"unscattered": _plain(u), "scattered": _plain(s)} for f, u, s in parts},
        }

    powers, fractions = in_units(torch.ones_like(entered)), in_units(entered)
    return {**powers, "fractions": fractions, "defect_percent": _plain(100 * (1 - left / entered))}


def _plain(values: Tensor) -> float | list[float]:
    numbers: list[float] = values.tolist()
    return numbers[0] if len(numbers) == 1 else numbers


def _cross_box(part: Source, media: Sequence[Medium], angles: int) -> Tensor:
    """The power of `part` of a light that leaves by each of `FACES`, [1 + media, 6, C].

    First what would if the box were empty, then what does unscattered in each of the `media`.
    """
    if isinstance(part, AmbientLight):
        grid, radiance = media[0].grid, part.radiance
        sides = [math.prod(grid.extent) / grid.extent[axis] for axis in (0, 0, 1, 1, 2, 2)]
        empty = math.pi * torch.outer(radiance.new_tensor(sides), radiance).double()
        dark = Moments(torch.zeros_like(media[0].extinction.value))
        given = dark, cell_gradient(dark.mean), radiance.view(-1, 1, 1, 1), angles
        found = [empty, *(empty + _sweep_out(medium, *given) for medium in media)]
        return torch.stack(torch.broadcast_tensors(*found))
    if isinstance(part, Sky):
        each = zip(part.travel, part.irradiance, strict=True)
        regions = (DirectionalLight(array_order(travel), power) for travel, power in each)
        return reduce(torch.add, (_follow_out(region, media) for region in regions))
    return _follow_out(part, media)


def _follow_out(light: Beamed, media: Sequence[Medium]) -> Tensor:
    """The same of a beam, along rays to the middles of cells at faces."""
    grid, field, powers = media[0].grid, media[0].extinction.field, list[Tensor]()
    for axis, side in product(range(3), range(2)):
        lines, size = grid.centers(field), list(grid.spacing)
        lines[axis] = field.new_full((1, 1, 1), (grid.lower, grid.upper)[side][axis])
        area, size[axis] = math.prod(size) / size[axis], 0.0
        rays, irradiance = _shine_on(light, lines, size, grid)
        outward = (rays.direction[:, axis] * (2 * side - 1)).clamp(min=0)
        leaving, sight = [area * irradiance * outward], look_along(grid, rays, RAY_BY_RAY)
        for medium in media:
            seen = march(absorb(medium), sight, RAY_BY_RAY, torch.ones_like(outward[None]))
            leaving.append(leaving[0] * seen)
        powers.append(torch.stack(torch.broadcast_tensors(*leaving)).sum(2, dtype=torch.float64))
    return torch.stack(powers, 1)


def _shine_on(
    light: Beamed, lines: Sequence[Tensor], size: Sequence[float], grid: Grid
) -> tuple[Rays, Tensor]:
    """The rays of `light` that end in the middles of cells at a face, and its irradiance [C, R].

    That is averaged over these cells of `size`, which lie along `lines`.
    """
    points = torch.stack(torch.broadcast_tensors(*lines), -1).flatten(0, 2)
    if isinstance(light, PointLight):
        eye = array_order(light.position)
        distance = torch.linalg.vector_norm(points - eye, dim=1, keepdim=True)
        rays = Rays(eye.expand_as(points), (points - eye) / distance, eye)
        return rays, light.intensity[:, None] / distance[:, 0] ** 2
    travel = normalize(array_order(light.direction), dim=0).expand_as(points)
    rays = Rays(points - 2 * math.hypot(*grid.extent) * travel, travel, None)
    if isinstance(light, DirectionalLight):
        return rays, light.irradiance[:, None]
    beam = light.position, light.direction, seen_radius(light.radius, grid)
    return rays, light.power[:, None] * mean_profile(lines, size, *beam).flatten()


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
        for axis, moved in sorted(enumerate(course.moved), key=lambda one: -abs(one[1])):
            layer = left.select(1 + axis, -int(moved > 0))
            gone[2 * axis + (moved > 0)] = abs(moved) * layer.sum((1, 2))
            layer *= 1 - abs(moved)
        power = power + 4 * math.pi * weight * math.prod(grid.spacing) / course.step * gone
    return power


def _leave_turned(beam: TurnedBeam, grid: Grid) -> Tensor:
    """The power [6, C] of a turned `beam` (E8.11), at faces the line through two cells."""
    power = beam.radiance.new_zeros(6, len(beam.radiance), dtype=torch.float64)
    for axis, along in enumerate(beam.direction.tolist()):
        layers = beam.radiance.unbind(1 + axis)[:: -1 if along > 0 else 1]
        last, before = layers[0], layers[min(1, len(layers) - 1)]
        area = 4 * math.pi * abs(along) * math.prod(grid.spacing) / grid.spacing[axis]
        power[2 * axis + (along > 0)] = area * (1.5 * last - 0.5 * before).clamp(min=0).sum((1, 2))
    return power


def lines(report: dict[str, Any]) -> list[str]:
    """The balance as lines of text."""

    def text(value: float | list[float], form: str) -> str:
        return ", ".join(format(one, form) for one in torch.tensor(value).view(-1).tolist())

    parts = report["fractions"]
    return [
        *(f"enters by {name}: {text(power, '.4g')}" for name, power in report["enters"].items()),
        f"absorbed: {text(report['absorbed'], '.4g')} ({text(parts['absorbed'], '.2%')})",
        *(
            f"leaves by {face}: unscattered {text(part['unscattered'], '.2%')}, "
            f"scattered {text(part['scattered'], '.2%')}"
            for face, part in parts["leaves"].items()
        ),
        f"neither absorbed nor left: {text(report['defect_percent'], '.2g')} %",
    ]
