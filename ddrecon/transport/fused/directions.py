"""Which directions of a sweep go together, and the numbers that kernels have of them.

Light that goes up or down in z is a way of its own; of directions within slices each has its
mirror image in the other. On a way directions go through the cells slice by slice in chunks, some
with y and others against it. A direction and its mirror images in x and y are a unit: their sums of
harmonics of each parity differ in signs alone.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from itertools import chain, product
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature
from ddrecon.transport.characteristics import Course, Direction

POINTS = 4
"""Cells at most that light comes from."""
MOST = 24
"""Directions at most in a chunk: more read moments less often, fewer need less of a cache."""
BLOCK = 2
"""Units that `moments.h` does at once: a chunk has so many, or a multiple; some may be empty."""
SLABS, LARGE = (4, 8), 2**20
"""Slices at most of which all lines are kept for the adjoint; the second in LARGE volumes.

Fewer fit into a cache, but more is saved before them.
"""


def piece_numbers(shape: tuple[int, int, int], colors: int, moments: int) -> int:
    """Numbers, at most, that a piece of directions has of its own.

    Those of moments, of gradients' and of two fields' cotangents, and lines of its lanes.
    """
    depth, height, width = shape
    lines = 2 * MOST * (SLABS[1] + 1) * height * width
    return colors * (depth * height * width * (moments + 5) + 2 * lines)


@dataclass(frozen=True)
class Step:
    """The `length` [u] of a way through a cell, to which light comes from up to four, of `weights`.

    Light has `moved` by so many cells along z, y and x. Each of `points` tells how many cells it
    lies before the cell along these, none or one. Where `is_along` the first lies in the same row:
    a recurrence in x.
    """

    direction: Direction
    weight: float
    length: float
    moved: tuple[float, ...]
    points: tuple[tuple[int, ...], ...]
    weights: tuple[float, ...]
    is_along: bool

    @staticmethod
    def of(grid: Grid, direction: Direction, weight: float) -> Step:
        """The step of a `direction` of the quadrature through `grid` (E2.9)."""
        course = Course.of(grid, direction)
        axis, moved = course.order[0] - 1, course.moved
        # The cells that light comes from, first that on the row itself where it goes along x.
        found: dict[tuple[int, ...], float] = {}
        for point in product(*((1,) if i == axis else (0, 1) for i in range(3))):
            part = math.prod(abs(m) if p else 1 - abs(m) for m, p in zip(moved, point, strict=True))
            if part > 0:
                found[point] = part
        is_along = axis == 2 and (0, 0, 1) in found
        points, weights = tuple(found), tuple(found.values())
        return Step(direction, weight, course.step, tuple(moved), points, weights, is_along)

    def course(self) -> list[int]:
        """The struct `Course` of kernels."""
        points = self.points + self.points[:1] * (POINTS - len(self.points))
        x_way = (self.moved[2] > 0) - (self.moved[2] < 0)
        return [x_way, self.is_along, len(self.points), *chain(*points)]

    def parts(self) -> list[float]:
        """The struct `Parts` of kernels."""
        return [self.length, *self.moved, *self.weights, *[0.0] * (POINTS - len(self.points))]


Unit = list[Step]
"""A direction and its mirror images in x and in y, as far as there are any."""


def _chunks(steps: list[Step], count: int) -> list[list[Unit]]:
    """The units of the `steps` of a way in so many chunks of about as many directions."""
    units: dict[tuple[float, ...], Unit] = {}
    for step in steps:
        z, y, x = step.direction
        units.setdefault((z, abs(y), abs(x)), []).append(step)
    chunks: list[list[Unit]] = [[] for _ in range(count)]
    for unit in sorted(units.values(), key=len, reverse=True):
        min(chunks, key=lambda chunk: sum(map(len, chunk))).append(unit)
    return chunks


@functools.cache
def make_tables(
    grid: Grid, count: int, moments: int, pieces: int, dtype: torch.dtype
) -> dict[str, Any]:
    """What kernels are given of `count` directions through `grid`, of light with so many `moments`.

    A `Course` and `Parts` (`given.h`) of each. `units` [U, 4]: places in the chunk of a direction
    and its mirror images in x, in y and in both, -1 for none; `order` [K]: moments by parity, even
    in y before odd, of each even in x before odd. `chunks`: by way and piece, a `Chunk` for each,
    of at most `most` directions.
    """
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), count)
    given = zip(points.tolist(), weights.tolist(), strict=True)
    steps = [Step.of(grid, (z, y, x), weight) for (z, y, x), weight in given]
    order, done = _by_parity(math.isqrt(moments) - 1), list[Step]()
    places, chunks, matrices = list[list[int]](), list[list[int]](), list[Tensor]()
    for is_up in (True, False):
        way = [step for step in steps if (step.moved > (0, 0, 0)) == is_up]
        for units in _chunks(way, math.ceil(len(way) / MOST / pieces) * pieces):
            own = sorted(chain(*units), key=lambda step: step.moved[1] < 0)
            ups = sum(step.moved[1] >= 0 for step in own)
            number = BLOCK * max(1, math.ceil(len(units) / BLOCK))
            chunks.append([len(done), ups, len(own), len(places), number, sum(map(len, matrices))])
            for unit in units:
                images = [2 * (step.direction[1] < 0) + (step.direction[2] < 0) for step in unit]
                at = dict(zip(images, map(own.index, unit), strict=True))
                places.append([at.get(image, -1) for image in range(4)])
            places += [[-1] * 4] * (number - len(units))
            matrices += _matrices(units, order, number)
            done += own
    whole = {"courses": [step.course() for step in done], "units": places, "order": order}
    return {name: torch.tensor(rows, dtype=torch.int32) for name, rows in whole.items()} | {
        "parts": torch.tensor([step.parts() for step in done], dtype=dtype),
        "matrices": torch.cat(matrices).to(dtype),
        "chunks": torch.tensor(chunks, dtype=torch.int32).view(2, pieces, -1, 6),
        "most": max(members for _, _, members, *_ in chunks),
    }


def _by_parity(degree: int) -> list[int]:
    """The harmonics up to `degree` by their parity in y, then in x: as mirror images tell."""
    images = torch.tensor([[0.48, 0.6, 0.64], [0.48, -0.6, 0.64], [0.48, 0.6, -0.64]])
    here, *there = harmonics(images, degree).T
    is_odd = torch.stack([here * image < 0 for image in there], 1).tolist()
    return sorted(range(len(is_odd)), key=is_odd.__getitem__)


def _matrices(units: list[Unit], order: list[int], number: int) -> list[Tensor]:
    """Y_k [K, number] of the image of each unit that goes up along x and y; those with weights."""
    rows = [[*unit[0].direction, unit[0].weight] for unit in units]
    rows += [[0.0] * 4] * (number - len(units))
    z, y, x, weights = torch.tensor(rows, dtype=torch.float64).T
    degree = math.isqrt(len(order)) - 1
    values = harmonics(torch.stack([z, y.abs(), x.abs()], 1), degree)[order]
    return [values.flatten(), (values * weights).flatten()]
