"""Multigrid's passes as kernels (`passes.h`): listed in a table once, launched as often as wanted.

On a GPU a pass is a launch, with a thread for each cell. On a processor an item is a row or a
slice; passes over few cells, and all passes where threads are no more than colors, share a launch,
in which a thread does the cells of a color.
"""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ddrecon.diffusion.hierarchy import STEPS, Coarsening, Hierarchy, Level, Passes
from ddrecon.diffusion.operator import Operator
from ddrecon.kernels.launch import launch_later, thread_count
from ddrecon.kernels.text import Bound, TextKernel, declarations
from ddrecon.numerics.reads import may_read

Kind = IntEnum(
    "Kind",
    "SCALE WEIGH COARSEN MATRIX PRODUCT SMOOTH RESIDUAL RELAX RESTRICT SOLVE CORRECT",
    start=0,
)
"""What a pass does, as `passes.h` has it."""
PASS = """
long kind, items, width, n[3], periodic, axes, face_colors, cell_colors, step, u, source, out;
F *c[3], *loss, *inverse, *kept, *below[3], *above[3], *results[4]
"""
"""What a pass is given, as `passes.h` declares it: eight bytes each."""
TOGETHER = 400
"""Numbers of a table that one launch writes: what a kernel is given has at most 4 KB."""
SMALL = 30_000
"""So few cells, of all colors, are best done by one thread."""


class Vector(NamedTuple):
    """Numbers of all colors on a grid, from a `place` in the work of a cycle on.

    `twin`: the place of another vector of that grid, for what does not change in place.
    """

    place: int
    shape: tuple[int, ...]
    twin: int = -1


class KernelPasses(Passes):
    """Lists the passes of a preparation, or of a cycle for vectors of so many `colors`.

    `is_by_cell`: whether an item does a cell, as on a GPU. `tensors`: what the table points to.
    """

    def __init__(self, like: Tensor, colors: int = 1):
        self.like, self.colors, self.is_by_cell = like, colors, like.is_cuda
        self.size, self.rows, self.tensors = 0, list[dict[str, int]](), list[Tensor]()

    def new_vector(self, shape: Sequence[int], *, has_twin: bool = False) -> Vector:
        """Room for a vector on a grid of this `shape` [z, y, x], or for two."""
        place, count = self.size, self.colors * math.prod(shape)
        self.size += count * (1 + has_twin)
        return Vector(place, tuple(shape), place + count if has_twin else -1)

    def scale(self, operator: Operator) -> tuple[Tensor, Tensor, Tensor]:
        shape = operator.loss.shape
        inverse, kept = (self.like.new_empty(shape) for _ in range(2))
        ties = self.like.new_empty(3, math.prod(shape) // self._width(shape, 2))
        self._add("SCALE", shape, operator, results=[inverse, kept, ties])
        return inverse, kept, ties

    def coarsen(self, operator: Operator, axis: int) -> tuple[Coarsening, Operator]:
        grid = tuple(operator.loss.shape[1:])
        shape = [(n + 1) // 2 if a == axis else n for a, n in enumerate(grid, 1)]
        faces, cells = ((len(t), *shape) for t in (operator.conductances[0], operator.loss))
        below, above, *results = (self.like.new_empty(faces) for _ in range(5))
        results.append(self.like.new_empty(cells))
        coarsening = Coarsening(axis, grid[axis - 1], below, above)
        weights = [below, above, results[axis - 1]]
        self._add_transfer("WEIGH", faces, grid, [coarsening], operator, results=weights)
        self._add("COARSEN", cells, operator, [coarsening], grid=grid, rows=1, results=results)
        z, y, x, loss = results
        return coarsening, Operator((z, y, x), loss, operator.periodic)

    def matrix(self, operator: Operator) -> Tensor:
        count = operator.loss[0].numel()
        matrix = self.like.new_empty(len(operator.loss), count, count, dtype=torch.float64)
        self._add("MATRIX", operator.loss.shape, operator, rows=0, results=[matrix])
        return matrix

    def run(self) -> None:
        program = Program(self, "prepare")
        launch(program.bind(self.like.new_empty(1)), program.cut(0, len(self.rows)))
        self.rows.clear()

    def product(self, operator: Operator, u: Vector, out: Vector) -> None:
        """A u."""
        self._add("PRODUCT", (self.colors, *u.shape), operator, u=u, out=out)

    def smooth(self, level: Level, source: Vector) -> Vector:
        out = self.new_vector(source.shape, has_twin=True)
        return self._add_level("SMOOTH", level, out, source=source)

    def relax(self, level: Level, u: Vector, source: Vector, step: float) -> Vector:
        out = Vector(u.twin, u.shape, u.place)
        return self._add_level("RELAX", level, out, u=u, source=source, step=STEPS.index(step))

    def residual(self, level: Level, u: Vector, source: Vector) -> Vector:
        out = Vector(u.twin, u.shape)
        return self._add_level("RESIDUAL", level, out, u=u, source=source)

    def restrict(self, level: Level, residual: Vector) -> Vector:
        for together in self._groups(level.coarsenings):
            grid, out = residual.shape, self.new_vector(together[-1].below.shape[1:])
            shape, vectors = (self.colors, *out.shape), {"source": residual, "out": out}
            self._add_transfer("RESTRICT", shape, grid, together, level.operator, **vectors)
            residual = out
        return residual

    def solve(self, inverse: Tensor, source: Vector) -> Vector:
        out = self.new_vector(source.shape, has_twin=True)
        shape, colors = (self.colors, *out.shape), len(inverse)
        self._add(
            "SOLVE", shape, rows=0, inverse=inverse, cell_colors=colors, source=source, out=out
        )
        return out

    def correct(self, level: Level, u: Vector, coarse: Vector) -> Vector:
        groups = self._groups(level.coarsenings)
        for number, together in reversed([*enumerate(groups)]):
            cells = {coarsening.axis: coarsening.cells for coarsening in together}
            grid = [cells.get(axis, n) for axis, n in enumerate(coarse.shape, 1)]
            # The last one, to the grid of u, adds to that what is kept.
            kept, out = (None, self.new_vector(grid)) if number else (level.kept, u)
            shape, values = (self.colors, *grid), {"source": coarse, "out": out, "kept": kept}
            self._add_transfer("CORRECT", shape, grid, together, level.operator, **values)
            coarse = out
        return u

    def _groups(self, coarsenings: Sequence[Coarsening]) -> list[Sequence[Coarsening]]:
        """Those of one pass: all on a GPU, where launches cost most; else one, as vector code."""
        return [coarsenings] if self.is_by_cell else [[coarsening] for coarsening in coarsenings]

    def _width(self, shape: Sequence[int], rows: int) -> int:
        """How many cells an item does: one, a row, or a slice."""
        return 1 if self.is_by_cell else math.prod(shape[len(shape) - rows :])

    def _add_level(self, kind: str, level: Level, out: Vector, **values: Any) -> Vector:
        values |= {"inverse": level.inverse, "kept": level.kept, "out": out}
        self._add(kind, (self.colors, *out.shape), level.operator, **values)
        return out

    def _add_transfer(
        self,
        kind: str,
        shape: Sequence[int],
        grid: Sequence[int],
        coarsenings: Sequence[Coarsening],
        operator: Operator,
        **values: Any,
    ) -> None:
        """Lists a pass along one axis, or more on a GPU. Across it rows need not be told apart."""
        axes = {coarsening.axis for coarsening in coarsenings}
        if not self.is_by_cell:
            shape, grid = (_merge_axes(sizes, axes) for sizes in (shape, grid))
        self._add(kind, shape, operator, coarsenings, grid=grid, rows=1, **values)

    def _add(
        self,
        kind: str,
        shape: Sequence[int],
        operator: Operator | None = None,
        coarsenings: Sequence[Coarsening] = (),
        rows: int = 2,
        **values: Any,
    ) -> None:
        """Lists a pass whose items fill `shape` [C, z, y, x]; the grid is that, or another one."""
        width = self._width(shape, rows)
        row: dict[str, Any] = {"kind": Kind[kind], "width": width}
        row |= {"items": math.prod(shape) // width, "n": values.pop("grid", shape[1:]), **values}
        if operator:
            row |= {"c": operator.conductances, "loss": operator.loss}
            row |= {"face_colors": len(operator.conductances[0]), "cell_colors": len(operator.loss)}
            row["periodic"] = sum(1 << axis for axis in operator.periodic)
        row["axes"] = sum(1 << coarsening.axis - 1 for coarsening in coarsenings)
        for coarsening in coarsenings:
            row[f"below_{coarsening.axis - 1}"] = coarsening.below
            row[f"above_{coarsening.axis - 1}"] = coarsening.above
        self.rows.append(dict(self._numbers_of(row)))

    def _numbers_of(self, row: dict[str, Any]) -> Iterator[tuple[str, int]]:
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
                for number, entry in enumerate(value):
                    yield from self._numbers_of({f"{name}_{number}": entry})


def entries_of(declared: str) -> Iterator[str]:
    """The names of the numbers and addresses that are `declared`, each entry of lists."""
    for _, _, name, count in declarations(declared):
        yield from [f"{name}_{entry}" for entry in range(count)] or [name]


def _merge_axes(shape: Sequence[int], axes: set[int]) -> tuple[int, ...]:
    """`shape` [(C,) z, y, x], in which axes that lie beside each other, and not in `axes`, are one.

    So that rows, along x, are as long as can be: all of a slice for what happens across slices.
    """
    *colors, z, y, x = shape
    if axes == {1}:
        return *colors, z, 1, y * x
    return (*colors, 1, z * y, x) if axes == {3} else (*colors, z, y, x)


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
    """A table of passes where kernels see it, and the launches that do them.

    `size`: how many numbers vectors take.
    """

    def __init__(self, passes: KernelPasses, name: str):
        like, self.colors, self.size = passes.like, passes.colors, passes.size
        self.kernel = passes_kernel(name, 8 * like.itemsize)
        self.rows, self.tensors = [*passes.rows], [*passes.tensors]
        names = [*entries_of(PASS)]
        numbers = [row.get(name, 0) for row in self.rows for name in names]
        self.table = _write_table(numbers, like)
        # So many cells of all colors are best done by one thread for each color.
        self.most = -1 if like.is_cuda else SMALL
        if not like.is_cuda and thread_count(like) <= self.colors:
            self.most = sys.maxsize

    def bind(self, work: Tensor) -> Bound:
        """The kernel, for vectors in `work`."""
        return self.kernel.bind({"table": self.table}, {"work": work})

    def cut(self, first: int, last: int) -> list[dict[str, int]]:
        """Launches of the passes from `first` to `last`: each all of one, or a color of several."""
        launches = list[dict[str, int]]()
        for number, row in enumerate(self.rows[first:last], first):
            is_shared = row["items"] * row["width"] > self.most
            if launches and launches[-1]["parts"] and not is_shared:
                launches[-1]["end"] = number + 1
                continue
            count, parts = (row["items"], 0) if is_shared else (self.colors, self.colors)
            launches.append({"count": count, "begin": number, "end": number + 1, "parts": parts})
        return launches


def launch(bound: Bound, launches: Sequence[Mapping[str, int]]) -> None:
    """Does the passes of a `bound` program, as it was `cut`."""
    for arguments in launches:
        bound.launch(**arguments)


@functools.cache
def passes_kernel(name: str, bits: int) -> TextKernel:
    """The passes of a table from `begin` to `end`: an item of each, or one of so many `parts`.

    `name`: those that `prepare` a hierarchy, or those of a `cycle`.
    """
    steps = ", ".join(f"F({step!r})" for step in STEPS)
    text = f"""
    for (int k = begin; k < end; ++k) {{
        const Pass<F>& pass = ((const Pass<F>*)table)[k];
        const Size from = parts ? pass.items * item / parts : item;
        const Size to = parts ? pass.items * (item + 1) / parts : item + 1;
        for (Size i = from; i < to; ++i) {name}(pass, work, {steps}, i);
    }}
    """
    declared = "long *table; int begin, end, parts; F *work"
    header = "diffusion/fused/passes.h"
    return TextKernel(f"multigrid_{name}", bits, text, declared, "work", header)


def name_kernels(like: Tensor) -> None:
    """Has the kernels of a solve on tensors `like` this compiled meanwhile."""
    for name in ("cycle", "prepare"):
        launch_later(passes_kernel(name, 8 * like.itemsize).kernel, like)


class KernelGrids:
    """The grids of an operator, and the program of products and cycles for each count of colors."""

    def __init__(self, operator: Operator):
        faces = max(map(len, operator.conductances))
        z, y, x = (c.expand(faces, -1, -1, -1).contiguous() for c in operator.conductances)
        loss = operator.loss.expand(max(faces, len(operator.loss)), -1, -1, -1).contiguous()
        self.operator = Operator((z, y, x), loss, operator.periodic)
        # Colors that share nothing are prepared one after another.
        colors = faces if faces == len(loss) else 1
        self.hierarchy = Hierarchy.of(self.operator, KernelPasses(loss, colors))
        self.programs: dict[int, tuple[Program, list[Vector]]] = {}

    def program(self, colors: int) -> tuple[Program, list[Vector]]:
        """The program, a cycle before a product; direction and residual, product and solution."""
        if colors not in self.programs:
            loss = self.operator.loss
            passes = KernelPasses(loss, colors)
            direction, residual = (passes.new_vector(loss.shape[1:]) for _ in range(2))
            solution = self.hierarchy.cycle(passes, residual)
            product = Vector(solution.twin, solution.shape)
            passes.product(self.operator, direction, product)
            vectors = [direction, residual, product, solution]
            self.programs[colors] = Program(passes, "cycle"), vectors
        return self.programs[colors]


class KernelCycle:
    """Products and V-cycles of an operator, of vectors like `source`, by kernels."""

    def __init__(self, operator: Operator, source: Tensor):
        grids = operator.once(KernelGrids)
        program, vectors = grids.program(len(source))
        work = source.new_empty(program.size)
        self.hierarchy, self._bound = grids.hierarchy, program.bind(work)
        last = len(program.rows) - 1
        self._cycle, self._product = program.cut(0, last), program.cut(last, last + 1)
        self.direction, self.residual, self.room, self._solution = (
            work[vector.place :][: source.numel()].view_as(source) for vector in vectors
        )

    def product(self) -> Tensor:
        """A times the direction."""
        launch(self._bound, self._product)
        return self.room

    def cycle(self) -> Tensor:
        """Roughly A^-1 times the residual."""
        launch(self._bound, self._cycle)
        return self._solution
