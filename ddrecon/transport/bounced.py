"""Beams that faces of the box reflect inside, before they are scattered (docs/theory.md E5.8)."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import array_order
from ddrecon.light.lights import BeamLight, DirectionalLight
from ddrecon.light.moments import add, beam_moments
from ddrecon.light.profile import RefractedBeam, enter_faces
from ddrecon.light.sky import Source
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.optics import reflectance
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.decay import decay_mean
from ddrecon.transport.characteristics import Characteristic, Ends, follow
from ddrecon.transport.mirror import lay_face

TURNS = 4
"""So often light is reflected, at most; what is left then leaves."""
LEAST = 1e-7
"""Light that is weaker, as a part of that which entered, is not followed."""


@dataclass(frozen=True)
class BoxTransit:
    """Parallel light that goes through the box once, from its faces to others.

    `direction` [3]: unit, array order; `irradiance` [C, z, y, x]: its mean in cells; `turns`: how
    often it was reflected; `released` [6, C]: the power that leaves by each face, in array order.
    """

    direction: Tensor
    irradiance: Tensor
    turns: int
    released: Tensor


def follow_inside(medium: Medium, beam: RefractedBeam, most: int = TURNS) -> Iterator[BoxTransit]:
    """The passages of a `beam` that has come in, which is reflected so often at `most`."""
    assert beam.face is not None and beam.at_face is not None
    grid, travel = medium.grid, array_order(beam.light.direction)
    value, power = medium.extinction.value, beam.light.irradiance.view(-1, 1, 1, 1)
    entering = (power * beam.at_face).squeeze(1 + beam.face)
    entering = entering.expand(max(len(entering), len(value)), -1, -1)
    course = Characteristic.along(grid, travel)
    place = course.axes.index(beam.face)
    flows: dict[tuple[int, ...], dict[int, Tensor]] = {
        (1, 1, 1): {place: lay_face(entering, place, course)}
    }
    strongest = float(entering.detach().abs().max())
    for turns in range(most + 1):
        turned: dict[tuple[int, ...], dict[int, Tensor]] = {}
        for signs, ends in flows.items():
            if (
                max(float(light.detach().abs().max()) for light in ends.values())
                < LEAST * strongest
            ):
                continue
            way = travel * travel.new_tensor(signs)
            course = Characteristic.along(grid, way)
            irradiance, gone = recompute(_pass, value, course, ends)
            released = value.new_zeros(6, len(entering))
            for place, axis in enumerate(course.axes):
                if way[axis] == 0:
                    continue
                inner = reflectance(way[axis].abs(), medium.index) if turns < most else 0.0
                area = math.prod(grid.spacing) / grid.spacing[axis] * way[axis].abs()
                out = area * gone[place].sum([d for d in range(3) if d != bool(place)])
                number = torch.arange(6, device=out.device) == 2 * axis + int(way[axis] > 0)
                released = released + number[:, None] * (1 - inner) * out
                image = tuple(-s if a == axis else s for a, s in enumerate(signs))
                back = turned.setdefault(image, {})
                back[place] = back.get(place, 0) + inner * gone[place]
            yield BoxTransit(way, irradiance, turns, released)
        flows = turned


def _pass(value: Tensor, course: Characteristic, ends: dict[int, Tensor]) -> tuple[Tensor, Ends]:
    """The mean in cells of extinction `value` of light that enters at `ends`, and what leaves."""
    depth = course.lay(value * course.step)
    colors = next(light.shape[int(place > 0)] for place, light in ends.items())
    source = torch.zeros_like(depth).expand(-1, colors, -1, -1)
    slices, _, rows, columns = source.shape
    shapes = (colors, rows, columns), (slices, colors, columns), (slices, colors, rows)
    across, row, column = (
        ends[place] if place in ends else depth.new_zeros(shape)
        for place, shape in enumerate(shapes)
    )
    passed = torch.exp(-depth).expand_as(source)
    arriving, gone = follow(passed, source, course, (across, row, column))
    return course.lift(arriving * decay_mean(depth)), gone


def reflected_light(cells: Medium, lights: Sequence[Source], degree: int) -> Tensor:
    """phi up to `degree` of beams' light, not yet scattered, once faces have reflected it.

    Of `lights` in `cells`; skies' light is not followed beyond the faces it comes to.
    """
    moments = [torch.zeros_like(cells.extinction.value)[None]]
    for light in lights:
        if isinstance(light, DirectionalLight | BeamLight):
            for beam in enter_faces(cells.grid, cells.index, light):
                for transit in follow_inside(cells, beam):
                    if transit.turns:
                        mean = transit.irradiance / (4 * math.pi)
                        moments.append(beam_moments(mean, transit.direction, degree))
    return functools.reduce(add, moments)
