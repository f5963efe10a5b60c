"""A hierarchy of grids in the memory of fused kernels, and a table that says where they lie.

A level of multigrid coarsens up to three axes one after another, so between two levels there are
grids that nobody relaxes on. Each grid is a stage; the last is solved directly. An array of a stage
has as many entries as the stage has cells: faces lie at the cell below them, and those on the box
hold zero. A row of the table says of each stage how many cells it has and where its arrays are.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.diffusion.operator import AXES, Operator, lower_cells
from ddrecon.diffusion.solvers.hierarchy import FEW_CELLS, Coarsest, strong_axes
from ddrecon.diffusion.solvers.scaled import ScaledMatrix
from ddrecon.kernels.launch import thread_count
from ddrecon.kernels.text import TextKernel

ROOM = "diffusion/solvers/fused"
SMALL = 30_000
"""So few cells, of all colors, are best done by one thread."""
STAGES = 128
"""More than there can be: each halves the cells along an axis."""


def read_names(header: str, enum: str) -> dict[str, int]:
    """The names of an `enum` in a `header`, with their numbers."""
    text = Path(__file__).with_name(header).read_text(encoding="utf-8")
    (names,) = re.findall(rf"enum {enum} \{{([^}}]*)\}}", text)
    return {name.strip(): number for number, name in enumerate(names.split(","))}


COLUMNS = read_names("levels.h", "Column")
MAKING = read_names("prepare.h", "Step")


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """The grids of an operator of so many `colors`.

    `scale`: S of the finest grid [colors, z, y, x]; `coarser`: how many numbers right sides and
    solutions of coarser levels are, in each color of a solve; `memory`: what the table points to.
    """

    colors: int
    table: Tensor
    scale: Tensor
    coarser: int
    memory: list[Tensor]

    @staticmethod
    def of(operator: Operator) -> Hierarchy:
        """All grids of `operator`."""
        matrix = _lay_out(operator)
        table, memory = torch.zeros(STAGES, COLUMNS["COLUMNS"], dtype=torch.int64), list[Tensor]()
        rows, stage, coarser = table.numpy(), 0, margin(matrix[0].shape[3])

        def write(name: str, *values: int | Tensor) -> None:
            """Numbers, or where arrays lie, in the stage's row from this column on."""
            memory.extend(value for value in values if isinstance(value, Tensor))
            for column, value in enumerate(values, COLUMNS[name]):
                rows[stage, column] = value.data_ptr() if isinstance(value, Tensor) else value

        def write_size() -> None:
            write("NZ", *matrix[0].shape[1:], -1, -1)

        write_size()
        while not stage or matrix[0][0].numel() > FEW_CELLS:
            *faces, scale, _ = level = _new_arrays(matrix[0], matrix[0].shape, 5)
            for step in ("SCALE_CELLS", "SCALE_FACES"):
                _run(step, matrix, level)
            write("SZ", *level)
            first = stage
            for axis in strong_axes(ScaledMatrix(scale, _compact(faces))):
                halved = [(n + 1) // 2 if a == axis else n for a, n in enumerate(matrix[0].shape)]
                coarse, weights = (_new_arrays(matrix[0], halved, count) for count in (4, 2))
                for step in ("WEIGH", "COARSEN"):
                    _run(step, matrix, [*coarse, *weights], axis)
                write("AXIS", axis - 1)
                write("BELOW", *weights)
                stage, matrix = stage + 1, coarse
                write_size()
            if stage == first:
                break
            rows[first, COLUMNS["NEXT"]] = stage
            size = room(matrix[0][0].numel(), matrix[0].shape[3])
            write("SOURCE", coarser, coarser + size)
            coarser += 2 * size
        else:
            coarsest = Operator(_compact(matrix[:3]), matrix[3])
            write("INVERSE", Coarsest.of(coarsest).inverse.contiguous())
        return Hierarchy(len(matrix[0]), table, memory[3], coarser, memory)


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


def room(cells: int, width: int) -> int:
    """How many numbers an array of so many takes with the margin before it."""
    return -(-cells // 16) * 16 + margin(width)


def _new_arrays(like: Tensor, shape: Sequence[int], count: int) -> list[Tensor]:
    """So many arrays beside each other, each after a margin of zeros, with another behind all."""
    before, cells = margin(shape[-1]), math.prod(shape)
    size = room(cells, shape[-1])
    block = like.new_empty(count * size + before)
    rows = block[: count * size].view(count, size)
    rows[:, :before] = block[-before:] = 0
    return [row[before : before + cells].view(*shape) for row in rows]


def _lay_out(operator: Operator) -> list[Tensor]:
    """Conductances and loss of `operator`, of as many colors as one of them has."""
    given = (*operator.conductances, operator.loss)
    colors = max(map(len, given))
    arrays = _new_arrays(operator.loss, (colors, *operator.loss.shape[1:]), 4)
    for axis, array, faces in zip(AXES, arrays[:3], operator.conductances, strict=True):
        lower_cells(array, axis).copy_(faces)
        array.select(axis, -1).zero_()
    arrays[3].copy_(operator.loss)
    return arrays


def _compact(faces: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """`faces` along z, y and x without those on the box (views)."""
    z, y, x = (lower_cells(array, axis) for axis, array in zip(AXES, faces, strict=True))
    return z, y, x


def _run(step: str, matrix: list[Tensor], made: list[Tensor], axis: int = 1) -> None:
    """A `step` of making a grid, whose arrays are `made`, of the same or a finer one's `matrix`."""
    colors, nz, ny, nx = made[0].shape
    given = {
        "width": nx, "rows": nz * ny, "colors": colors, "nz": nz, "ny": ny, "nx": nx,
        "step": MAKING[step], "axis": axis - 1, "finer": matrix[0].shape[1:], "matrix": matrix,
    }  # fmt: skip
    rest = [None] * (6 - len(made))
    kernel = prepare_kernel(8 * matrix[0].element_size())
    kernel.launch(colors * nz * ny, given, {"made": [*made, *rest]})


@functools.cache
def prepare_kernel(bits: int) -> TextKernel:
    """A step of making a hierarchy, in a row of cells."""
    text = """
    const Row row(item, width, rows, colors);
    const Mesh<F> mesh(row, nz, ny, nx, F(1), F(1), F(1));
    prepare(row, mesh, step, axis, ny, finer, matrix, made);
    """
    given = "int width, rows, colors, nz, ny, nx, step, axis, finer[3]; F *matrix[4], *made[6]"
    return TextKernel("prepare", bits, text, given, "made", f"{ROOM}/prepare.h")
