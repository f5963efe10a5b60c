"""Which directions of a sweep go together, and the numbers that kernels have of them.

Light that goes up or down in z is a way of its own; of directions within slices each has its
mirror image in the other. On a way all directions go through the cells slice by slice, some with
y and others against it: groups. In a group a direction and its mirror image in x are a pair: their
sums of harmonics of either parity in x differ in signs alone.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import Course, Direction
from ddrecon.diffusion.rounds.fused.jobs import Chunks
from ddrecon.diffusion.rounds.fused.records import table
from ddrecon.diffusion.rounds.fused.swept import units_of_parts
from ddrecon.grid import Grid
from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import sphere_quadrature

X = 2
POINTS = 4
"""Cells at most where a step begins."""


@dataclass(frozen=True)
class Step:
    """The step to a cell along a direction: from a mean of up to four cells, of given `weights`.

    Slices lie across `axis`. Each of `points` tells how many cells it lies before the cell along z,
    y and x, none or one, of light with the `signs`. Where `is_along` the first lies in the same
    row: a recurrence in x.
    """

    direction: Direction
    axis: int
    half: float
    signs: tuple[int, int, int]
    points: tuple[tuple[int, ...], ...]
    weights: tuple[float, ...]
    is_along: bool

    @staticmethod
    def of(grid: Grid, direction: Direction) -> Step:
        """The step of `direction` through `grid`, of which half is `half` [u] long (E11)."""
        course = Course.of(grid, direction)
        axis = course.order[0] - 1
        moved: list[float] = [0.0, 0.0, 0.0]
        moved[axis] = float(course.forward)
        for drift, dim in zip(course.drift, course.order[2:], strict=True):
            moved[dim - 1] = drift
        # The cells around where light was, first that on the row itself where it goes along x.
        found: dict[tuple[int, ...], float] = {}
        for point in product(*((1,) if i == axis else (0, 1) for i in range(3))):
            parts = (abs(m) if p else 1 - abs(m) for m, p in zip(moved, point, strict=True))
            found[point] = math.prod(parts)
        is_along = found.get((0, 0, 1), 0.0) > 0 and axis == X
        kept = {point: weight for point, weight in found.items() if weight > 0}
        z, y, x = (1 if m > 0 else -1 if m < 0 else 0 for m in moved)
        return Step(
            direction,
            axis,
            0.5 * course.step,
            (z, y, x),
            tuple(kept),
            tuple(kept.values()),
            is_along,
        )

    def course(self) -> dict[str, Any]:
        """What the struct `Course` of kernels says of it."""
        fill = POINTS - len(self.points)
        return {
            "signs": self.signs, "axis": self.axis, "is_along": self.is_along,
            "count": len(self.points), "points": self.points + self.points[:1] * fill,
        }  # fmt: skip

    def parts(self) -> list[float]:
        """What `Parts` says: half the step and the weights."""
        return [self.half, *self.weights, *[0.0] * (POINTS - len(self.points))]

    @property
    def is_up(self) -> bool:
        """Whether it belongs to the way up in z; within slices of each direction or its mirror."""
        return self.signs > (0, 0, 0)


@functools.cache
def steps_of(grid: Grid, count: int) -> tuple[tuple[Step, float], ...]:
    """The step along each of `count` directions through `grid`, and the quadrature's weight."""
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), count)
    steps = (Step.of(grid, (z, y, x)) for z, y, x in points.tolist())
    return tuple(zip(steps, weights.tolist(), strict=True))


@dataclass(frozen=True)
class Tables:
    """What kernels are given of directions: a `Group`, `Course` and `Parts` of each.

    `pairs` [P, 2]: places in the group, the second -1 for none; `order` [K]: moments, those even in
    x first. `chunks`: by way, and then by piece, ranges of groups that go through the cells
    together, of at most `most` directions.
    """

    groups: Tensor
    courses: Tensor
    parts: Tensor
    pairs: Tensor
    matrices: Tensor
    order: Tensor
    most: int
    chunks: Chunks


@functools.cache
def make_tables(
    grid: Grid, count: int, moments: int, most: int, pieces: int, dtype: torch.dtype
) -> Tables:
    """The tables of `count` directions through `grid`, of light with so many `moments`.

    On each way the directions are cut into chunks of about `most` at most, in `pieces`.
    """
    made, steps = _Maker(moments), steps_of(grid, count)
    chunks = []
    for is_up in (True, False):
        units = _pairs([each for each in steps if each[0].is_up == is_up], made.odd > 0)
        chunks.append(made.add_way(units, most, pieces))
    return Tables(
        table("Group", made.groups),
        table("Course", [step.course() for step in made.steps]),
        torch.tensor([step.parts() for step in made.steps], dtype=dtype),
        torch.tensor(made.pairs, dtype=torch.int32),
        torch.cat(made.matrices).to(dtype),
        torch.tensor(made.order, dtype=torch.int32),
        made.most,
        tuple(chunks),
    )


Unit = list[tuple[Step, float]]
"""A direction with its weight, and perhaps its mirror image in x."""


def _pairs(steps: list[tuple[Step, float]], is_paired: bool) -> list[Unit]:
    """The directions, those along y first, mirror images together."""
    units: dict[tuple[float, ...], Unit] = {}
    for step, weight in sorted(steps, key=lambda each: each[0].signs[1] < 0):
        z, y, x = step.direction
        key = (z, y, abs(x)) if is_paired else (z, y, x)
        units.setdefault(key, []).append((step, weight))
    return list(units.values())


class _Maker:
    """Tables while they are made, as lists."""

    def __init__(self, moments: int):
        self.degree = round(moments**0.5) - 1
        # A direction and its mirror image tell which harmonics are odd in x.
        odd = self._harmonics([(0.48, 0.6, 0.64)]) * self._harmonics([(0.48, 0.6, -0.64)])
        is_odd = (odd[:, 0] < 0).tolist()
        self.units = units_of_parts(self.degree)
        self.order = sorted(range(moments), key=lambda k: is_odd[k])
        self.odd, self.most = sum(is_odd), 0
        self.groups, self.steps = list[dict[str, int]](), list[Step]()
        self.pairs, self.matrices = list[list[int]](), list[Tensor]()

    def add_way(
        self, units: list[Unit], most: int, pieces: int
    ) -> tuple[tuple[tuple[int, int], ...], ...]:
        """Adds a way's directions; the chunks of each piece, as ranges of groups."""
        total = sum(map(len, units))
        count = math.ceil(total / most / pieces) * pieces
        chunks: list[list[Unit]] = [[] for _ in range(count)]
        done = 0
        for unit in units:
            chunks[min(done * count // total, count - 1)].append(unit)
            done += len(unit)
        ranges = [self._add_chunk(chunk) for chunk in chunks if chunk]
        per_piece = -(-len(ranges) // pieces)
        return tuple(tuple(ranges[i : i + per_piece]) for i in range(0, len(ranges), per_piece))

    def _add_chunk(self, units: list[Unit]) -> tuple[int, int]:
        begin, before = len(self.groups), 0
        for y_way in (1, -1):
            group = [unit for unit in units if (unit[0][0].signs[1] < 0) == (y_way < 0)]
            if group:
                self._add_group(group, y_way, before)
                before += sum(map(len, group))
        self.most = max(self.most, before)
        return begin, len(self.groups)

    def _add_group(self, units: list[Unit], y_way: int, before: int) -> None:
        group = {
            "y_way": y_way, "begin": len(self.steps), "members": sum(map(len, units)),
            "first_pair": len(self.pairs), "pairs": len(units),
            "matrices": sum(map(len, self.matrices)), "before": before,
        }  # fmt: skip
        self.groups.append(group)
        place = 0
        for unit in units:
            self.pairs.append([place, place + 1 if len(unit) > 1 else -1])
            self.steps += [step for step, _ in unit]
            place += len(unit)
        # Y_k of pairs as sums over moments, and as sums over pairs; the same with weights.
        values = self._harmonics([unit[0][0].direction for unit in units])[self.order].T
        of_parts = self.units[self.order]
        weights = values.new_tensor([unit[0][1] for unit in units])[:, None]
        for matrix in (values / of_parts, values * of_parts * weights):
            self.matrices += [matrix.reshape(-1), matrix.T.reshape(-1)]

    def _harmonics(self, directions: list[Direction]) -> Tensor:
        """Y_k [K, N] of `directions`."""
        return harmonics(torch.tensor(directions, dtype=torch.float64), self.degree)
