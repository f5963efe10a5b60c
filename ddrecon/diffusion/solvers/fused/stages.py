"""Where the grids of a hierarchy lie in memory, as a table that kernels read.

A level of multigrid coarsens up to three axes one after another, so between two levels there are
grids that nobody relaxes on. Each grid is a stage; the last is solved directly. An array of a stage
has as many entries as the stage has cells: faces lie at the cell below them, and those on the box
hold zero. A row of the table says of each stage how many cells it has and where its arrays begin.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from torch import Tensor

from ddrecon.diffusion.solvers.fused.kernels import COLUMNS
from ddrecon.diffusion.solvers.hierarchy import FEW_CELLS, STRONG

Shape = tuple[int, int, int]
Axes = tuple[tuple[int, ...], ...]
"""The axes (0 is z) that each level coarsens."""
_NAMES, STAGE = list(COLUMNS), COLUMNS["COLUMNS"]
MATRIX, COARSENED, SCALED = _NAMES[5:9], _NAMES[9:11], _NAMES[11:16]
"""Of stages that are not the finest, of those that are coarsened, and of levels (`levels.h`)."""


@dataclass(frozen=True)
class Stages:
    """The `table` [stages, columns], and how many numbers the arrays it points into have.

    `data` serves all solves, `work` only while the hierarchy is made, `vectors` of a color one
    solve. `levels`: the stages where a level begins, the coarsest among them.
    """

    axes: Axes
    colors: int
    table: tuple[int, ...]
    levels: tuple[int, ...]
    data: int
    work: int
    vectors: int

    def column(self, stage: int, name: str) -> int:
        """An entry of the table."""
        return self.table[stage * STAGE + COLUMNS[name]]

    def view(self, numbers: Tensor, stage: int, name: str, shape: Sequence[int]) -> Tensor:
        """An array of a stage in `numbers`, [colors, *shape] (a view)."""
        begin, count = self.column(stage, name), self.colors * math.prod(shape)
        return numbers[begin : begin + count].view(self.colors, *shape)

    def shape(self, stage: int) -> Shape:
        """How many cells a stage has along z, y and x."""
        z, y, x = (self.column(stage, name) for name in ("NZ", "NY", "NX"))
        return z, y, x


def first_guess(shape: Shape) -> Axes:
    """The axes of each level where all of more than one cell are strong."""
    return tuple(_completed(shape, ()))


def strong_axes(shape: Shape, found: Axes, means: Sequence[Sequence[float]]) -> Axes:
    """The axes that levels have to coarsen, by the mean scaled conductances of levels as `found`.

    Right up to the first level that differs from `found`, and a guess for those after it.
    """
    axes: list[tuple[int, ...]] = []
    for mine, strengths in zip(found, means, strict=True):
        long = [axis for axis in range(3) if shape[axis] > 1]
        most = max((strengths[axis] for axis in long), default=0.0)
        axes.append(tuple(axis for axis in long if not strengths[axis] < STRONG * most))
        shape = _halved(shape, axes[-1])
        if axes[-1] != mine:
            break
    return tuple(_completed(shape, axes))


def margin(width: int) -> int:
    """How many numbers lie before and behind every array of a grid so wide.

    Loops over slices read as far, and multiply by zero. It also keeps arrays from beginning at the
    same place of a processor's cache, in lines of which they all begin.
    """
    return (width + 16) // 16 * 16


@functools.cache
def stages_of(shape: Shape, colors: int, axes: Axes) -> Stages:
    """The stages of `shape` cells and matrices of so many `colors`."""
    rows, sizes = list(_rows(shape, axes)), {"data": 0, "work": 0, "vectors": 0}
    levels = [i for i, row in enumerate(rows) if row["IS_LEVEL"]]
    following = dict(itertools.pairwise(levels))

    def take(kind: str, count: int) -> int:
        begin = sizes[kind] + margin(shape[2])
        sizes[kind] = begin + -(-count // 16) * 16
        return begin

    for i, row in enumerate(rows):
        cells, is_last = _cells(row), row["AXIS"] < 0
        row["NEXT"] = following.get(i, -1)
        if i > 0:
            row |= {name: take("work", colors * cells) for name in MATRIX}
        if not is_last:
            coarse = colors * _cells(rows[i + 1])
            row |= {name: take("data", coarse) for name in COARSENED}
        if row["IS_LEVEL"] and not (is_last and i > 0):
            row |= {name: take("data", colors * cells) for name in SCALED}
        if is_last:
            row["INVERSE"] = take("data", colors * cells**2)
        if row["IS_LEVEL"] and i > 0:
            row |= {name: take("vectors", cells) for name in ("SOURCE", "U")}
    for kind in sizes:
        take(kind, 0)
    table = tuple(row.get(name, 0) for row in rows for name in _NAMES[:STAGE])
    return Stages(axes, colors, table, tuple(levels), **sizes)


def _rows(shape: Shape, axes: Axes) -> Iterator[dict[str, int]]:
    for level in axes:
        for number, axis in enumerate(level):
            yield dict(zip(_NAMES[:4], (*shape, axis), strict=True)) | {"IS_LEVEL": number == 0}
            shape = _halved(shape, (axis,))
    yield dict(zip(_NAMES[:4], (*shape, -1), strict=True)) | {"IS_LEVEL": True}


def _cells(row: dict[str, int]) -> int:
    return row["NZ"] * row["NY"] * row["NX"]


def _completed(shape: Shape, axes: Sequence[tuple[int, ...]]) -> Iterator[tuple[int, ...]]:
    """`axes`, which lead to `shape`, and those of further levels down to few cells."""
    yield from axes
    is_first = not axes
    while max(shape) > 1 and (is_first or math.prod(shape) > FEW_CELLS):
        long = tuple(axis for axis in range(3) if shape[axis] > 1)
        yield long
        shape, is_first = _halved(shape, long), False


def _halved(shape: Shape, axes: Sequence[int]) -> Shape:
    z, y, x = ((n + 1) // 2 if axis in axes else n for axis, n in enumerate(shape))
    return z, y, x
