"""Passes of multigrid and conjugate gradients as kernels (`passes.h`), in a table for all solves.

On a GPU a pass is a launch, with a thread for each cell or pair. On a processor an item is a row or
a slice; passes over few cells, and all passes where threads are no more than colors, share a
launch, in which a thread does the cells of a color.
"""

import functools
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.hierarchy import STEPS, Coarsening, Hierarchy, Level, Passes, pair_cells
from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solve import TensorSteps
from ddrecon.kernels.launch import launch_later, thread_count
from ddrecon.kernels.text import PACKAGE, Bound, TextKernel, declarations, members_of
from ddrecon.numerics.remember import may_read

HEADER = "diffusion/fused/passes.h"
_KINDS = (PACKAGE / HEADER).read_text(encoding="utf-8").split("enum Kind {")[1].split("}")[0]
KIND = {name: number for number, name in enumerate(re.findall(r"\w+", _KINDS))}
"""What passes do, by name."""
TOGETHER = 400
"""Numbers of a table that one launch writes: what a kernel is given has at most 4 KB."""
SMALL = 30_000
"""So few cells, of all colors, are best done by one thread."""


@dataclass(frozen=True)
class Vector:
    """Numbers of all colors on a grid, from a `place` in the work of a solve on.

    `twin`: the place of another vector of that grid, for what does not change in place.
    """

    place: int
    shape: tuple[int, ...]
    twin: int = -1


class KernelPasses(Passes):
    """Lists the passes of a preparation, or of a solve for vectors of so many `colors`.

    `tensors`: what the rows of the table point to.
    """

    def __init__(self, like: Tensor, colors: int = 1):
        self.like, self.colors = like, colors
        self.size, self.rows, self.tensors = 0, list[dict[str, int]](), list[Tensor]()

    def new_vector(self, shape: Sequence[int], *, has_twin: bool = False) -> Vector:
        """Room for a vector on a grid of this `shape` [z, y, x], or for two."""
        place, count = self.size, self.colors * math.prod(shape)
        self.size += count * (1 + has_twin)
        return Vector(place, tuple(shape), place + count if has_twin else -1)

    def scale(self, operator: Operator) -> tuple[Tensor, Tensor]:
        shape = operator.loss.shape
        inverse, coupling = (self.like.new_empty(shape) for _ in range(2))
        self.add("SCALE", shape, operator, results=[inverse, coupling])
        return inverse, coupling

    def coarsen(self, operator: Operator, axis: int) -> tuple[Coarsening, Operator]:
        cells, (_, *shape) = operator.loss.shape[axis], operator.loss.shape
        shape[axis - 1] = (cells + 1) // 2
        below, above, *faces = (
            self.like.new_empty(len(operator.conductances[0]), *shape) for _ in range(5)
        )
        loss = self.like.new_empty(len(operator.loss), *shape)
        coarsening = Coarsening(axis, cells, below, above)
        # The axis first, then those across.
        along, *across = (faces[(axis + k) % 3 - 1] for k in range(3))
        fine = [operator.conductances[(axis + k) % 3 - 1] for k in range(3)]
        results = [below, above, along, *across, loss]
        self._add_pairs("WEIGH", coarsening, operator, len(loss), c=fine, results=results)
        weights = {"axis": axis - 1, "cells": cells, "below": below, "above": above}
        self.add("STIFFEN", below.shape, operator, shape[2], **weights, results=[along])
        return coarsening, pair_cells(operator, axis, faces, loss)

    def run(self) -> None:
        # Nothing depends on scales: a GPU finds those of all grids at once, at the end.
        self.rows.sort(key=lambda row: row["kind"] == KIND["SCALE"])
        program, nothing = Program(self, "prepare"), self.like.new_empty(1)
        program.run(program.bind(nothing, nothing), 0)

    def smooth(self, level: Level, source: Vector) -> Vector:
        out = self.new_vector(source.shape, has_twin=True)
        return self._relax("SMOOTH", level, out, source=source)

    def relax(self, level: Level, u: Vector, source: Vector, step: float) -> Vector:
        out = Vector(u.twin, u.shape, u.place)
        return self._relax("RELAX", level, out, u=u, source=source, step=STEPS.index(step))

    def residual(self, level: Level, u: Vector, source: Vector) -> Vector:
        return self._relax("RESIDUAL", level, Vector(u.twin, u.shape), u=u, source=source)

    def _relax(self, kind: str, level: Level, out: Vector, **values: Any) -> Vector:
        values |= {"inverse": level.inverse, "coupling": level.coupling, "out": out}
        self.add(kind, (self.colors, *out.shape), level.operator, **values)
        return out

    def restrict(self, level: Level, residual: Vector) -> Vector:
        if self.like.is_cuda:
            shape = level.coarsenings[-1].below.shape[1:]
            out = self.new_vector(shape)
            self._add_steps("DESCEND", level, shape, source=residual, out=out)
            return out
        for coarsening in level.coarsenings:
            vectors = {"source": residual, "out": self.new_vector(coarsening.below.shape[1:])}
            self._add_pairs("RESTRICT", coarsening, level.operator, self.colors, **vectors)
            residual = vectors["out"]
        return residual

    def solve(self, inverse: Tensor, source: Vector) -> Vector:
        out = self.new_vector(source.shape, has_twin=True)
        values: dict[str, Any] = {"inverse": inverse, "cell_colors": len(inverse)}
        self.add("SOLVE", (self.colors, *out.shape), width=1, **values, source=source, out=out)
        return out

    def correct(self, level: Level, u: Vector, coarse: Vector) -> Vector:
        if self.like.is_cuda:
            self._add_steps("ASCEND", level, u.shape, source=coarse, out=u)
            return u
        for number, coarsening in reversed([*enumerate(level.coarsenings)]):
            shape = [*coarse.shape]
            shape[coarsening.axis - 1] = coarsening.cells
            # The last one, to the grid of u, is added to that.
            coupling, out = (level.coupling, u) if number == 0 else (None, self.new_vector(shape))
            values = {"source": coarse, "out": out, "coupling": coupling}
            self._add_pairs("CORRECT", coarsening, level.operator, self.colors, **values)
            coarse = out
        return u

    def _add_steps(self, kind: str, level: Level, shape: Sequence[int], **values: Any) -> None:
        """Lists a pass through all coarsenings of a `level`, to the grid of this `shape`."""
        steps = level.coarsenings
        values |= {"steps": len(steps), "axes": [step.axis - 1 for step in steps]}
        values |= {"coupling": level.coupling, "belows": [step.below for step in steps]}
        values |= {"aboves": [step.above for step in steps], "n": level.operator.loss.shape[1:]}
        self.add(kind, (self.colors, *shape), level.operator, **values)

    def _add_pairs(
        self, kind: str, coarsening: Coarsening, operator: Operator, colors: int, **values: Any
    ) -> None:
        """Lists a pass over pairs of cells: an item has all of a line, or pairs side by side."""
        shape, axis = coarsening.below.shape[1:], coarsening.axis
        before, behind = math.prod(shape[: axis - 1]), math.prod(shape[axis:])
        values = {"below": coarsening.below, "above": coarsening.above} | values
        values["n"] = before, coarsening.cells, behind
        width = behind if behind > 1 else shape[axis - 1]
        self.add(kind, (colors, *shape), operator, width, **values)

    def add(
        self,
        kind: str,
        shape: Sequence[int],
        operator: Operator | None = None,
        width: int | None = None,
        **values: Any,
    ) -> None:
        """Lists a pass over all of `shape` [C, z, y, x]; `width`: of an item, None for a slice."""
        width = 1 if self.like.is_cuda else width or shape[2] * shape[3]
        row: dict[str, Any] = {"kind": KIND[kind], "items": math.prod(shape) // width}
        row |= {"width": width, "n": shape[1:], "face_colors": 1}
        if operator:
            row |= {"c": operator.conductances, "loss": operator.loss}
            row |= {"face_colors": len(operator.conductances[0]), "cell_colors": len(operator.loss)}
            row["periodic"] = sum(1 << axis for axis in operator.periodic)
        self.rows.append(dict(self._numbers_of(row | values)))

    def _numbers_of(self, row: Mapping[str, Any]) -> Iterator[tuple[str, int]]:
        """Each number of a `row` of the table, with its name."""
        for name, value in row.items():
            if isinstance(value, Tensor):
                self.tensors.append(value)
                yield name, value.data_ptr()
            elif isinstance(value, Vector):
                yield name, value.place
            elif isinstance(value, int | None):
                yield name, value or 0
            else:
                yield from self._numbers_of({f"{name}_{k}": entry for k, entry in enumerate(value)})


def entries_of(declared: str) -> Iterator[str]:
    """The names of the numbers and addresses that are `declared`, each entry of lists."""
    for _, _, name, count in declarations(declared):
        yield from [f"{name}_{entry}" for entry in range(count)] or [name]


def _write_table(numbers: Sequence[int], like: Tensor) -> Tensor:
    """`numbers` where `like` lies."""
    if may_read():
        # Without waiting: the numbers have left the processor's memory when this returns.
        return torch.tensor(numbers).to(like.device, non_blocking=True)
    # A graph copies nothing from there; it keeps what kernels are given by value.
    table = like.new_empty(len(numbers), dtype=torch.int64)
    for start in range(0, len(numbers), TOGETHER):
        row = [*numbers[start : start + TOGETHER]]
        values = {"start": start, "count": len(row), "n": row + [0] * (TOGETHER - len(row))}
        table_kernel().launch(1, values, {"table": table})
    return table


@functools.cache
def table_kernel() -> TextKernel:
    """Writes numbers that it is given to a table."""
    text = "".join(f"if ({k} < count) table[start + {k}] = n[{k}];\n" for k in range(TOGETHER))
    declared = f"long n[{TOGETHER}], start, count, *table"
    return TextKernel("multigrid_table", 64, text, declared, "table")


class Program:
    """A table of passes where kernels see it, and the launches of its steps.

    `steps`: the pass with which each begins. `size`: how many numbers vectors take.
    """

    def __init__(self, passes: KernelPasses, name: str, steps: Sequence[int] = (0,)):
        like, self.size, rows = passes.like, passes.size, passes.rows
        self.kernel, self.tensors = passes_kernel(name, 8 * like.itemsize), passes.tensors
        names = [*entries_of(members_of(HEADER, "Pass"))]
        self.table = _write_table([row.get(name, 0) for row in rows for name in names], like)
        # So many cells of all colors are best done by one thread for each color.
        most = -1 if like.is_cuda else SMALL
        if not like.is_cuda and thread_count(like) <= passes.colors:
            most = sys.maxsize
        ends = zip(steps, [*steps[1:], len(rows)], strict=True)
        self.launches = [_list_launches(rows, *end, passes.colors, most) for end in ends]

    def bind(self, work: Tensor, solution: Tensor) -> Bound:
        """The kernel, for vectors in `work` and a `solution`."""
        return self.kernel.bind({"table": self.table}, {"work": work, "solution": solution})

    def run(self, bound: Bound, step: int) -> None:
        """Does the passes of a step."""
        for arguments in self.launches[step]:
            bound.launch(**arguments)


def _list_launches(
    rows: Sequence[Mapping[str, int]], first: int, last: int, colors: int, most: int
) -> list[dict[str, int]]:
    """Launches of the passes from `first` to `last`.

    A pass over more than `most` cells is one, but for scales, which do not depend on each other.
    Others share it, an item does a color of them all.
    """
    launches = list[dict[str, int]]()
    for number, row in enumerate(rows[first:last], first):
        is_large = row["items"] * row["width"] > most
        if number > first and row["kind"] == rows[number - 1]["kind"] == KIND["SCALE"] and most < 0:
            launches[-1]["end"] = number + 1
            continue
        if launches and launches[-1]["shares"] and not is_large:
            launches[-1]["end"] = number + 1
            continue
        count, shares = (row["items"], 0) if is_large else (colors, colors)
        launches.append({"count": count, "begin": number, "end": number + 1, "shares": shares})
    return launches


@functools.cache
def passes_kernel(name: str, bits: int) -> TextKernel:
    """The passes of a table from `begin` to `end`: an item of each, or one of so many `shares`.

    `name`: those that `prepare` a hierarchy, or those that `iterate`.
    """
    steps = ", ".join(f"F({step!r})" for step in STEPS)
    text = f"""
    for (int k = begin; k < end; ++k) {{
        const Pass<F>& pass = ((const Pass<F>*)table)[k];
        const Size from = shares ? pass.items * item / shares : item;
        const Size to = shares ? pass.items * (item + 1) / shares : item + (item < pass.items);
        for (Size i = from; i < to; ++i) {name}(pass, work, solution, {steps}, i);
    }}
    """
    declared = "long *table; int begin, end, shares; F *work, *solution"
    return TextKernel(f"multigrid_{name}", bits, text, declared, "work solution", HEADER)


def name_kernels(like: Tensor) -> None:
    """Has the kernels of a solve on tensors `like` this compiled meanwhile."""
    for name in ("iterate", "prepare"):
        launch_later(passes_kernel(name, 8 * like.itemsize).kernel, like)


class KernelGrids:
    """The grids of an operator, and the program of a solve for each count of colors."""

    def __init__(self, operator: Operator):
        faces = max(map(len, operator.conductances))
        z, y, x = (c.expand(faces, -1, -1, -1).contiguous() for c in operator.conductances)
        loss = operator.loss.expand(max(faces, len(operator.loss)), -1, -1, -1).contiguous()
        self.operator = replace(operator, conductances=(z, y, x), loss=loss, prepared={})
        # Colors that share nothing are prepared one after another.
        colors = faces if faces == len(loss) else 1
        self.hierarchy = Hierarchy.of(self.operator, KernelPasses(loss, colors))
        self.programs: dict[int, tuple[Program, list[Vector]]] = {}

    def program(self, colors: int) -> tuple[Program, list[Vector]]:
        """The three steps of an iteration, and the vectors of `KernelSteps`, in their order."""
        if colors not in self.programs:
            operator, passes = self.operator, KernelPasses(self.operator.loss, colors)
            grid = operator.loss.shape[1:]
            direction, residual = (passes.new_vector(grid) for _ in range(2))
            numbers = passes.new_vector((1, 1, KernelSteps.NUMBERS))
            sums = passes.new_vector(grid if operator.loss.is_cuda else grid[:1])
            preconditioned = self.hierarchy.cycle(passes, residual)
            product = Vector(preconditioned.twin, grid)
            turn = len(passes.rows)
            passes.rows[-1]["sums"] = sums.place
            values: dict[str, Any] = {"u": direction, "numbers": numbers, "sums": sums}
            values["inverse"], shape = self.hierarchy.inverse_diagonal, (colors, *grid)
            passes.add("TURN", shape, operator, **values, source=preconditioned)
            passes.add("PRODUCT", shape, operator, **values, out=product)
            passes.add("ADVANCE", shape, operator, **values, source=product, out=residual)
            vectors = [direction, residual, preconditioned, product, numbers, sums]
            self.programs[colors] = Program(passes, "iterate", (0, turn, turn + 2)), vectors
        return self.programs[colors]


class KernelSteps(TensorSteps):
    """The same by kernels."""

    def __init__(self, operator: Operator, source: Tensor):
        grids, colors = operator.once(KernelGrids), len(source)
        self._program, vectors = grids.program(colors)
        self.inverse = grids.hierarchy.inverse_diagonal
        self.solution, work = source.new_zeros(source.shape), source.new_empty(self._program.size)
        self._bound = self._program.bind(work, self.solution)
        (
            self.direction,
            self.residual,
            self.preconditioned,
            self.product,
            numbers,
            self._sums,
        ) = (
            work[vector.place :][: colors * math.prod(vector.shape)].view(colors, *vector.shape)
            for vector in vectors
        )
        self.residual.copy_(source)
        self.direction.zero_()
        self._keep(numbers.flatten(1).fill_(1))

    def precondition(self) -> None:
        self._run(0, self.power)

    def turn(self) -> None:
        self._run(1, self.curvature)

    def advance(self) -> None:
        self._run(2, self.square)

    def _run(self, step: int, total: Tensor) -> None:
        self._program.run(self._bound, step)
        torch.sum(self._sums.flatten(1), 1, out=total.view(-1))
