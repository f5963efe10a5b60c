"""Which directions of a sweep go together, and in which thread."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from itertools import pairwise, product

from ddrecon.diffusion.rounds.characteristics import Course, Direction
from ddrecon.grid import Grid

PIECE = {True: 5, False: 9}
"""Directions at most that go side by side: fewer where I of all slices is kept for the adjoint."""
EVEN = 1.05
"""A thread may have this many times the mean work."""


@dataclass(frozen=True)
class Piece:
    """Directions `begin` to `begin + count` that cross slices across `axis` in the same way."""

    axis: int
    forward: int
    begin: int
    count: int


@dataclass(frozen=True)
class Schedule:
    """What crosses slices across z and y; or across z and x, then of cells with y and x exchanged.

    `directions`: their numbers in the quadrature; `numbers` and `signs`: their rows of
    `kernels.records.Given`, but for the weights of moments; `pieces` of them.
    """

    directions: tuple[int, ...]
    numbers: tuple[tuple[float, ...], ...]
    signs: tuple[tuple[int, int, int], ...]
    pieces: tuple[Piece, ...]

    def cut(self, most: int) -> list[Piece]:
        """The pieces, cut into about equal ones of at most so many directions."""
        found = []
        for piece in self.pieces:
            parts = -(-piece.count // most)
            bounds = [i * piece.count // parts for i in range(parts + 1)]
            for a, b in pairwise(bounds):
                found.append(Piece(piece.axis, piece.forward, piece.begin + a, b - a))
        return found


@functools.cache
def schedules(grid: Grid, directions: tuple[Direction, ...]) -> tuple[Schedule, ...]:
    """The schedule across z and y, and that across x: a quadrature has directions of both."""
    courses = [Course.of(grid, direction) for direction in directions]
    axes = [course.order[0] - 1 for course in courses]
    across = ({i: a for i, a in enumerate(axes) if (a == 2) == is_x} for is_x in (False, True))
    return tuple(_schedule(directions, courses, each) for each in across)


def _schedule(
    directions: tuple[Direction, ...], courses: list[Course], axes: dict[int, int]
) -> Schedule:
    order: list[int] = []
    pieces = []
    for axis, forward in product((0, 1, 2), (1, -1)):
        group = [i for i, a in axes.items() if a == axis and courses[i].forward == forward]
        if group:
            pieces.append(Piece(min(axis, 1), forward, len(order), len(group)))
            order += group
    numbers, signs = [], []
    for i in order:
        row, column = courses[i].drift
        numbers.append((0.5 * courses[i].step, abs(row), abs(column), *directions[i]))
        is_whole = {abs(row), abs(column)} <= {0.0, 1.0}
        signs.append((1 if row >= 0 else -1, 1 if column >= 0 else -1, int(is_whole)))
    return Schedule(tuple(order), tuple(numbers), tuple(signs), tuple(pieces))


Item = tuple[int, int, int, int, int, int]
"""Axis, way, first direction, how many, color, and whether it is its thread's first of the color.
"""


@functools.cache
def share_items(
    schedule: Schedule, colors: int, threads: int, is_kept: bool, is_apart: bool
) -> tuple[list[Item], list[int]]:
    """Each piece in each color, in the order of threads, and where each thread's begin.

    Pieces are cut until all threads have about as much to do; where colors are kept `is_apart`,
    each has one thread.
    """
    for most in range(PIECE[is_kept], 0, -1):
        shares, work = _deal(schedule.cut(most), colors, threads, is_apart)
        if is_apart or max(work) <= EVEN * sum(work) / threads:
            break
    items: list[Item] = []
    bounds = [0]
    for share in shares:
        seen: set[int] = set()
        for piece, color in share:
            is_first = color not in seen
            seen.add(color)
            items.append((piece.axis, piece.forward, piece.begin, piece.count, color, is_first))
        bounds.append(len(items))
    return items, bounds


def _deal(
    pieces: list[Piece], colors: int, threads: int, is_apart: bool
) -> tuple[list[list[tuple[Piece, int]]], list[int]]:
    """What each thread gets, and how much: the largest pieces first, each to who has least."""
    shares: list[list[tuple[Piece, int]]] = [[] for _ in range(threads)]
    work = [0] * threads
    for piece in sorted(pieces, key=lambda piece: -piece.count):
        for color in range(colors):
            least = color % threads if is_apart else work.index(min(work))
            shares[least].append((piece, color))
            work[least] += piece.count
    return shares, work
