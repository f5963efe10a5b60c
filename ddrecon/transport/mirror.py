"""Faces of the box that reflect light inside (docs/theory.md E2.13, E5.8).

As sweeps meet them, what enters along a direction is what left along its mirror image in the sweep
before, and by what has since been added to the moments of light there. So nothing enters wrongly
where rounds have come to rest, and no energy is lost between directions. Beams are followed from
face to face before they are scattered.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ddrecon.grid import Grid, array_order
from ddrecon.light.lights import BeamLight, DirectionalLight
from ddrecon.light.moments import add, beam_moments
from ddrecon.light.profile import RefractedBeam, enter_faces
from ddrecon.light.sky import Source
from ddrecon.medium.coefficients import Medium
from ddrecon.medium.optics import quadrature_reflectances, reflectance
from ddrecon.numerics.autodiff import recompute
from ddrecon.numerics.decay import decay_mean
from ddrecon.transport.characteristics import Characteristic, Direction, Ends, follow

SIDES = tuple((axis, end) for axis in range(3) for end in (0, -1))
"""Of each face, the array axis across which it lies and the index of cells there."""


@dataclass(eq=False)
class Mirror:
    """The faces of `grid` in sweeps along `directions`, of harmonics `values` [N, K].

    `besides` reflects light that is swept apart, and of which only the sum is reflected here.
    """

    grid: Grid
    index: float
    directions: list[Direction]
    values: Tensor
    besides: Mirror | None = None
    outgoing: list[Ends] = field(default_factory=list)
    before: list[Ends] = field(default_factory=list)
    more: list[Tensor] = field(default_factory=list)
    swept: list[Tensor] = field(default_factory=list)

    def __post_init__(self) -> None:
        numbers = {tuple(direction): n for n, direction in enumerate(self.directions)}
        self.images = [
            [
                numbers[tuple(-c if a == axis else c for a, c in enumerate(direction))]
                for axis in range(3)
            ]
            for direction in self.directions
        ]
        self.reflected = quadrature_reflectances(self.index, len(self.directions)).tolist()

    def begin(self, light: Tensor | None) -> None:
        """`light` [K, C, z, y, x] is what a sweep begins with, less what is there without faces.

        None stands for what the last sweep has found.
        """
        self.before, self.outgoing = self.outgoing, []
        if light is None:
            self.more = [torch.zeros_like(layer) for layer in self.more]
            return
        self.more = _layers(light)
        for mirror in (self, self.besides):
            if self.before and mirror is not None:
                self.more = [m - s for m, s in zip(self.more, mirror.swept, strict=True)]

    def entering(self, number: int) -> Ends:
        """What enters along direction `number`."""
        direction = self.directions[number]
        course, ends = Characteristic.of(self.grid, direction), list[Tensor]()
        for place, axis in enumerate(course.axes):
            image = self.images[number][axis]
            layer = self.more[2 * axis + (direction[axis] < 0)]
            layer = lay_face(torch.tensordot(self.values[image].to(layer), layer, 1), place, course)
            for earlier in (
                self.before,
                self.besides.outgoing if self.besides and self.before else [],
            ):
                if earlier and course.moved[axis]:
                    layer = layer + earlier[image][place]
            ends.append(self.reflected[number][axis] * layer)
        return ends[0], ends[1], ends[2]

    def end(self, light: Tensor) -> None:
        """`light` is what the sweep has found, as of `begin`."""
        self.swept = _layers(light)

    def released(self, number: int) -> Ends:
        """What goes out of the box along direction `number` after the last sweep."""
        axes = Characteristic.of(self.grid, self.directions[number]).axes
        gone = (
            (1 - self.reflected[number][axis]) * layer
            for axis, layer in zip(axes, self.outgoing[number], strict=True)
        )
        across, rows, columns = gone
        return across, rows, columns


def _layers(light: Tensor) -> list[Tensor]:
    return [light.select(2 + axis, end) for axis, end in SIDES]


def lay_face(layer: Tensor, place: int, course: Characteristic) -> Tensor:
    """`layer` [C, ...] of a face, its axes in array order, as that at a `place` in `Ends`."""
    if place == 0:
        return layer
    slices, along = course.axes[0], course.axes[3 - place]
    return layer.movedim(2 if along < slices else 1, 0)


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
