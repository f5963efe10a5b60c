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

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import Course, Direction
from ddrecon.diffusion.rounds.fused.jobs import Chunks
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
    """What kernels are given of directions; numbers of a group or direction lie side by side.

    `groups` [G, 8]: the way in y, first direction, how many, first pair, how many, how many of
    these with harmonics odd in x, where their `matrices` are, directions before it in its chunk;
    `points` [D, 16]: how many, the sign of x, whether along x, then z, y, x of each; `parts`
    [D, 5]: half a step and weights; `pairs` [P, 2]: places in the group, the second -1 for none;
    `moments` [K]: those even in x first, `even` of them. `chunks`: by way, and then by piece,
    ranges of groups that go through the cells together, of at most `most` directions.
    """

    groups: Tensor
    points: Tensor
    parts: Tensor
    pairs: Tensor
    matrices: Tensor
    moments: Tensor
    even: int
    most: int
    chunks: Chunks


@functools.cache
def make_tables(
    grid: Grid,
    count: int,
    moments: int,
    most: int,
    pieces: int,
    dtype: torch.dtype,
) -> Tables:
    """The tables of `count` directions through `grid`, of light with so many `moments`.

    On each way the directions are cut into chunks of about `most` at most, in `pieces`.
    """
    made = _Maker(moments)
    chunks = []
    steps = steps_of(grid, count)
    for is_up in (True, False):
        units = _pairs([each for each in steps if each[0].is_up == is_up], made.odd > 0)
        chunks.append(made.add_way(units, most, pieces))

    def whole(rows: list[list[int]]) -> Tensor:
        return torch.tensor(rows, dtype=torch.int32)

    return Tables(
        whole(made.groups),
        whole(made.points),
        torch.tensor(made.parts, dtype=dtype),
        whole(made.pairs),
        torch.cat(made.matrices).to(dtype),
        torch.tensor(made.order, dtype=torch.int32),
        moments - made.odd,
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
        self.groups, self.points, self.pairs = (
            list[list[int]](),
            list[list[int]](),
            list[list[int]](),
        )
        self.parts, self.matrices = list[list[float]](), list[Tensor]()

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
        # Pairs with harmonics odd in x come first.
        has_odd = [self.odd > 0 and unit[0][0].direction[2] != 0 for unit in units]
        units = sorted(units, key=lambda unit: -abs(unit[0][0].direction[2]))
        first, first_pair = len(self.points), len(self.pairs)
        for unit in units:
            place = len(self.points) - first
            self.pairs.append([place, place + 1 if len(unit) > 1 else -1])
            for step, _ in unit:
                self._add_step(step)
        at = sum(map(len, self.matrices))
        members = len(self.points) - first
        group = y_way, first, members, first_pair, len(units), sum(has_odd), at, before
        self.groups.append(list(group))
        # Y_k of pairs as sums over moments, and as sums over pairs; the same with weights.
        values = self._harmonics([unit[0][0].direction for unit in units])[self.order].T
        of_parts = self.units[self.order]
        weights = values.new_tensor([unit[0][1] for unit in units])[:, None]
        even = len(self.order) - self.odd
        for matrix in (values / of_parts, values * of_parts * weights):
            parts = matrix[:, :even], matrix[: sum(has_odd), even:]
            self.matrices += [part.reshape(-1) for part in parts]
            self.matrices += [part.T.reshape(-1) for part in parts]

    def _harmonics(self, directions: list[Direction]) -> Tensor:
        """Y_k [K, N] of `directions`."""
        return harmonics(torch.tensor(directions, dtype=torch.float64), self.degree)

    def _add_step(self, step: Step) -> None:
        fill = POINTS - len(step.points)
        points = step.points + step.points[:1] * fill
        self.points.append(
            [
                len(step.points),
                step.signs[2],
                step.is_along,
                *(n for point in points for n in point),
                0,
            ]
        )
        self.parts.append([step.half, *step.weights, *[0.0] * fill])
