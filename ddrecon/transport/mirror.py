"""Faces of the box that reflect light inside, as sweeps meet them (docs/theory.md E2.13).

What enters along a direction is what left along its mirror image in the sweep before, and by what
has since been added to the moments of light there. So nothing enters wrongly where rounds have come
to rest, and no energy is lost between directions.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.medium.optics import quadrature_reflectances
from ddrecon.transport.characteristics import Characteristic, Direction, Ends

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
    left: list[Ends] = field(default_factory=list)
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
        self.before, self.left = self.left, []
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
            for earlier in (self.before, self.besides.left if self.besides and self.before else []):
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
            for axis, layer in zip(axes, self.left[number], strict=True)
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
