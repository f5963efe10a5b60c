"""Which directions of a sweep go together, and the numbers that kernels have of them.

Light that goes up or down in z is a way of its own; of directions within slices each has its
mirror image in the other. On a way directions go through the cells slice by slice in chunks, some
with y and others against it: groups. In a group a direction and its mirror image in x are a pair:
their sums of harmonics of either parity in x differ in signs alone.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, groupby, product
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import Course, Direction
from ddrecon.diffusion.rounds.fused.swept import units_of_parts
from ddrecon.grid import Grid
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature

POINTS = 4
"""Cells at most that light comes from."""
MOST_OF_FEW, MOST, FEW = 9, 16, 4
"""Directions at most in a chunk: of FEW moments, and of many.

More read many moments less often; fewer leave more of a cache to each.
"""
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
"""A direction, and perhaps its mirror image in x."""


def _chunks(steps: list[Step], is_paired: bool, count: int) -> list[list[Unit]]:
    """The `steps` of a way in about equal chunks, in each those along y first."""
    units: dict[tuple[float, ...], Unit] = {}
    for step in sorted(steps, key=_goes_down_y):
        z, y, x = step.direction
        units.setdefault((z, y, abs(x) if is_paired else x), []).append(step)
    chunks: list[list[Unit]] = [[] for _ in range(count)]
    done = 0
    for unit in units.values():
        chunks[done * count // len(steps)].append(unit)
        done += len(unit)
    return chunks


def _goes_down_y(step: Step) -> bool:
    return step.moved[1] < 0


@functools.cache
def make_tables(
    grid: Grid, count: int, moments: int, pieces: int, dtype: torch.dtype
) -> dict[str, Any]:
    """What kernels are given of `count` directions through `grid`, of light with so many `moments`.

    A `Group`, `Course` and `Parts` (`given.h`) of each; `pairs` [P, 2]: places in the group, the
    second -1 for none; `order` [K]: moments, those even in x first. `chunks`: by way and piece,
    ranges of groups that go through the cells together, of at most `most` directions.
    """
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), count)
    given = zip(points.tolist(), weights.tolist(), strict=True)
    steps = [Step.of(grid, (z, y, x), weight) for (z, y, x), weight in given]
    most = MOST_OF_FEW if moments <= FEW else MOST
    order, done = _even_first(math.isqrt(moments) - 1), list[Step]()
    groups, pairs, ranges = list[list[int]](), list[list[int]](), list[list[int]]()
    matrices, largest = list[Tensor](), 0
    for is_up in (True, False):
        way = [step for step in steps if (step.moved > (0, 0, 0)) == is_up]
        number = math.ceil(len(way) / most / pieces) * pieces
        for chunk in _chunks(way, moments > 1, number):
            first, begin = len(groups), len(done)
            for is_down, units in groupby(chunk, key=lambda unit: _goes_down_y(unit[0])):
                own, place = list(units), len(done)
                lies = place, sum(map(len, own)), len(pairs), len(own), sum(map(len, matrices))
                groups.append([-1 if is_down else 1, *lies, place - begin])
                for unit in own:
                    pairs.append([len(done) - place, len(done) + 1 - place][: len(unit)])
                    pairs[-1] += [-1] * (2 - len(unit))
                    done += unit
                matrices += _matrices(own, order)
            ranges.append([first, len(groups)])
            largest = max(largest, len(done) - begin)
    whole = {"groups": groups, "courses": [step.course() for step in done], "pairs": pairs}
    return {name: torch.tensor(rows, dtype=torch.int32) for name, rows in whole.items()} | {
        "parts": torch.tensor([step.parts() for step in done], dtype=dtype),
        "matrices": torch.cat(matrices).to(dtype),
        "order": torch.tensor(order, dtype=torch.int32),
        "chunks": torch.tensor(ranges, dtype=torch.int32).view(2, pieces, -1, 2),
        "most": largest,
    }


def _even_first(degree: int) -> list[int]:
    """The harmonics up to `degree`, those even in x first.

    A direction and its mirror image tell.
    """
    here, there = harmonics(torch.tensor([[0.48, 0.6, 0.64], [0.48, 0.6, -0.64]]), degree).T
    is_odd = (here * there < 0).tolist()
    return sorted(range(len(is_odd)), key=is_odd.__getitem__)


def _matrices(units: list[Unit], order: list[int]) -> Iterator[Tensor]:
    """Y_k of pairs as sums over moments, and as sums over pairs; the same with weights."""
    directions = torch.tensor([unit[0].direction for unit in units], dtype=torch.float64)
    degree = math.isqrt(len(order)) - 1
    values, of_parts = harmonics(directions, degree)[order].T, units_of_parts(degree)[order]
    weights = values.new_tensor([[unit[0].weight] for unit in units])
    for matrix in (values / of_parts, values * of_parts * weights):
        yield from (matrix.flatten(), matrix.T.flatten())
