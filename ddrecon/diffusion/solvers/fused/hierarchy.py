"""A hierarchy of grids in the memory of fused kernels, and a table that says where they lie.

A level of multigrid coarsens up to three axes one after another, so between two levels there are
grids that nobody relaxes on. Each grid is a stage; the last is solved directly. An array of a stage
has as many entries as the stage has cells: faces lie at the cell below them, and those on the box
hold zero. A row of the table says of each stage how many cells it has and where its arrays are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, islice

import torch
from torch import Tensor

from ddrecon.diffusion.operator import AXES, Operator, lower_cells
from ddrecon.diffusion.solvers.fused.kernels import COLUMNS, MAKING, prepare_kernel
from ddrecon.diffusion.solvers.hierarchy import FEW_CELLS, STRONG, Coarsest
from ddrecon.kernels.compiling import clear_in_rehearsal
from ddrecon.kernels.launch import thread_count

SMALL = 30_000
"""So few cells, of all colors, are best done by one thread."""
STAGES = 128
"""More than there can be: each halves the cells along an axis."""
_NAMES = list(COLUMNS)
MATRIX, COARSENED, SCALED = _NAMES[5:9], _NAMES[9:11], _NAMES[11:16]
"""Arrays of stages beyond the finest, of those that are coarsened, and of levels."""


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """The grids of an operator of so many `colors`, by levels that coarsen these `axes`.

    `scale`: S of the finest grid [colors, z, y, x]; `coarser`: how many numbers right sides and
    solutions of coarser levels are, in each color of a solve; `memory`: what the table points to.
    """

    colors: int
    table: Tensor
    axes: tuple[tuple[int, ...], ...]
    scale: Tensor
    coarser: int
    memory: list[Tensor]

    @staticmethod
    def of(operator: Operator) -> Hierarchy:
        """All grids of `operator`."""
        making = _Making(operator)
        while axes := making.strong_axes():
            making.coarsen(axes)
        return making.end()


def shares_of(cells: int, colors: int, like: Tensor) -> tuple[int, int]:
    """Into how many shares a color's slices are cut, and how many threads work on those of all.

    So that threads have equally many.
    """
    threads = thread_count(like) if cells * colors > SMALL else 1
    return threads // math.gcd(threads, colors), threads


def margin(width: int) -> int:
    """How many numbers lie before and behind every array of a grid so wide.

    Loops over slices read as far, and multiply by zero. It also keeps arrays from beginning at the
    same place of a processor's cache, in lines of which they all begin.
    """
    return (width + 16) // 16 * 16


class _Arrays:
    """Arrays of numbers `like` these, between margins."""

    def __init__(self, like: Tensor, width: int):
        self.like, self.margin = like, margin(width)
        self.blocks: list[Tensor] = []

    def take(self, counts: Sequence[int]) -> Iterator[int]:
        """The addresses of new arrays of so many numbers."""
        sizes = [-(-count // 16) * 16 + self.margin for count in counts]
        self.blocks.append(self.like.new_empty(sum(sizes) + self.margin))
        clear_in_rehearsal(self.blocks[-1:])
        begin, size = self.blocks[-1].data_ptr(), self.like.element_size()
        places = accumulate(sizes, initial=self.margin)
        return (begin + place * size for place in places)

    def view(self, address: int, block: int, *shape: int) -> Tensor:
        """The array at this address, in one of the blocks."""
        memory = self.blocks[block]
        begin = (address - memory.data_ptr()) // memory.element_size()
        return memory[begin : begin + math.prod(shape)].view(shape)


class _Making:
    """A hierarchy that is being made, down to a `stage` of this `shape`."""

    def __init__(self, operator: Operator):
        loss, matrix = operator.loss, (*operator.conductances, operator.loss)
        self.stage, self.shape = 0, tuple(loss.shape[1:])
        self.colors = max(map(len, matrix))
        cells, width = math.prod(self.shape), self.shape[2]
        self.shares, self.threads = shares_of(cells, self.colors, loss)
        self.kept, self.work = _Arrays(loss, width), _Arrays(loss, width)
        self.axes: list[tuple[int, ...]] = []
        self.coarser = self.kept.margin
        self.table = torch.zeros(STAGES, COLUMNS["COLUMNS"], dtype=torch.int64)
        self.rows = self.table.numpy()
        items = self.colors * self.shares
        self.strengths = loss.new_zeros(items, 3, dtype=torch.float64)
        is_each = [len(tensor) == self.colors for tensor in matrix]
        given = {"table": self.table, "matrix": matrix, "is_each": is_each}
        scratch = loss.new_empty(items * 3 * (width + 3))
        made = {"scratch": scratch, "strengths": self.strengths}
        self.kernel = prepare_kernel(8 * loss.element_size()).bind(given, made)
        self._put("NZ", [*self.shape, -1, -1])
        self._put("SZ", islice(self.kept.take([self.colors * cells] * len(SCALED)), len(SCALED)))
        self._run(0)

    def strong_axes(self) -> tuple[int, ...]:
        """The axes to coarsen next; none where there are few cells."""
        if self.axes and math.prod(self.shape) <= FEW_CELLS:
            return ()
        items = self.colors * (1 if self.axes else self.shares)
        sums = self.strengths[:items].sum(0).tolist()
        # Sums over faces, of which there are n - 1 for n cells.
        means = {axis: sums[axis] * n / (n - 1) for axis, n in enumerate(self.shape) if n > 1}
        most = max(means.values(), default=0.0)
        return tuple(axis for axis, mean in means.items() if not mean < STRONG * most)

    def coarsen(self, axes: tuple[int, ...]) -> None:
        """The stages of a level that coarsens these `axes`, down to the next level."""
        shapes = [self.shape]
        for axis in axes:
            last = enumerate(shapes[-1])
            shapes.append(tuple((n + 1) // 2 if other == axis else n for other, n in last))
        counts = [self.colors * math.prod(shape) for shape in shapes[1:]]
        cells = counts[-1] // self.colors
        scaled = SCALED if cells > FEW_CELLS else []
        kept = self.kept.take(
            [count for count in counts for _ in COARSENED] + counts[-1:] * len(scaled)
        )
        work = self.work.take([count for count in counts for _ in MATRIX])
        first = self.stage
        for axis, self.shape in zip(axes, shapes[1:], strict=True):
            self._put("AXIS", [axis])
            self._put(COARSENED[0], islice(kept, len(COARSENED)))
            self.stage += 1
            self._put("NZ", [*self.shape, -1, -1, *islice(work, len(MATRIX))])
        self.rows[first, COLUMNS["NEXT"]] = self.stage
        self._put("SZ", islice(kept, len(scaled)))
        size = -(-cells // 16) * 16 + self.kept.margin
        self._put("SOURCE", [self.coarser, self.coarser + size])
        self.coarser += 2 * size
        self.axes.append(axes)
        self._run(first)

    def end(self) -> Hierarchy:
        """The hierarchy, when its coarsest grid has been solved."""
        shape, colors = self.shape, self.colors
        if self.axes:
            # Faces lie at the cell below them.
            *faces, lost = (self.work.view(self._at(name), -1, colors, *shape) for name in MATRIX)
            z, y, x = (lower_cells(c, axis) for axis, c in zip(AXES, faces, strict=True))
            inverse = Coarsest.of(Operator((z, y, x), lost)).inverse
            self._put("INVERSE", islice(self.kept.take([inverse.numel()]), 1))
            self.kept.view(self._at("INVERSE"), -1, *inverse.shape).copy_(inverse)
        self.stage = 0
        scale = self.kept.view(self._at("SCALE"), 0, colors, *self.kept.like.shape[1:])
        axes = tuple(self.axes)
        return Hierarchy(colors, self.table, axes, scale, self.coarser, self.kept.blocks)

    def _put(self, name: str, values: Iterable[int]) -> None:
        """Writes `values` of the stage from this column on."""
        begin, row = COLUMNS[name], list(values)
        self.rows[self.stage, begin : begin + len(row)] = row

    def _at(self, name: str) -> int:
        return int(self.rows[self.stage, COLUMNS[name]])

    def _run(self, first: int) -> None:
        """Coarsens the stages from `first` on, and scales the last where it is a level's.

        Threads share each step of the finest level.
        """
        last, parts = self.stage, self.shares
        if parts > 1 and first == 0:
            steps = [(name, s, s + 1) for s in range(last) for name in ("WEIGHTS", "COARSE_CELLS")]
            steps += [(name, 0, 0) for name in ("SCALE_CELLS", "SCALE_FACES") if last == 0]
            for name, stage, end in steps:
                self._launch(name, stage, end, parts)
            first = last
        if first > 0 or parts == 1:
            self._launch("ALL", first, last, 1)

    def _launch(self, step: str, stage: int, last: int, parts: int) -> None:
        items = self.colors * parts
        threads = min(self.threads, items)
        self.kernel.launch(items, threads, step=MAKING[step], stage=stage, last=last, parts=parts)
