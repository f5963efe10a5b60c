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
from ddrecon.kernels.launch import thread_count
from ddrecon.kernels.text import TextKernel

ROOM = "diffusion/solvers/fused"
SMALL = 30_000
"""So few cells, of all colors, are best done by one thread."""
FINE = 200_000
"""Grids of so many cells are made by all threads, which takes a launch for each step."""
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
        given, like = (*operator.conductances, operator.loss), operator.loss
        shape = max(map(len, given)), *like.shape[1:]
        table = torch.zeros(STAGES, COLUMNS["COLUMNS"], dtype=torch.int64)
        rows, memory, work = table.numpy(), list[Tensor](), list[Tensor]()
        stage, coarser, steps, threads = 0, margin(shape[3]), MAKING["STEPS"], thread_count(like)
        sums = like.new_empty(threads, 3, dtype=torch.float64)
        sources = {"table": table, "colors": shape[0]}
        kernel = prepare_kernel(8 * like.element_size()).bind(sources, {"sums": sums})

        def add(kept: list[Tensor], name: str, count: int) -> Tensor:
            """So many arrays of `shape`, of which the row of the `stage` knows from a column on."""
            kept.append(arrays := _new_arrays(like, shape, count))
            rows[stage, COLUMNS[name] :][:count] = [one.data_ptr() for one in arrays]
            return arrays

        def make(first: int, last: int) -> list[float]:
            """Does these steps; how strong the last level's scaled conductances are by axis."""
            parts = threads if work[0][0].numel() > FINE else 1
            for step in range(first, last) if parts > 1 else (first,):
                end = step + 1 if parts > 1 else last
                if step % steps >= MAKING["WEIGH"] or rows[step // steps, COLUMNS["SCALE"]]:
                    kernel.launch(parts, parts, first=step, last=end, parts=parts)
            totals = zip(sums[:parts].sum(0).tolist(), shape[1:], strict=True)
            return [total * n / max(n - 1, 1) for total, n in totals]

        rows[:, COLUMNS["AXIS"]] = rows[:, COLUMNS["NEXT"]] = -1
        rows[0, :3] = shape[1:]
        *laid, loss = add(work, "CZ", 4)
        loss.copy_(operator.loss)
        for axis, faces, own in zip(AXES, operator.conductances, laid, strict=True):
            lower_cells(own, axis).copy_(faces)
            own.select(axis, -1).zero_()
        scale, is_level = add(memory, "SZ", 5)[3], True
        strengths = make(0, MAKING["WEIGH"])
        while is_level and (axes := strong_axes(shape, strengths)):
            first = stage
            for axis in axes:
                rows[stage, COLUMNS["AXIS"]] = axis - 1
                shape = *shape[:axis], (shape[axis] + 1) // 2, *shape[axis + 1 :]
                add(memory, "BELOW", 2)
                stage += 1
                rows[stage, :3] = shape[1:]
                matrix = add(work, "CZ", 4)
            size = room(matrix[0].numel(), shape[3])
            rows[first, COLUMNS["NEXT"]] = stage
            rows[stage, COLUMNS["SOURCE"] :][:2] = coarser, coarser + size
            coarser, is_level = coarser + 2 * size, matrix[0][0].numel() > FEW_CELLS
            if is_level:
                add(memory, "SZ", 5)
            strengths = make(first * steps + MAKING["WEIGH"], stage * steps + 2 * is_level)
            del work[:-1]
        if not is_level:
            z, y, x = (lower_cells(faces, axis) for axis, faces in zip(AXES, matrix, strict=False))
            memory.append(Coarsest.of(Operator((z, y, x), matrix[3])).inverse.contiguous())
            rows[stage, COLUMNS["INVERSE"]] = memory[-1].data_ptr()
        return Hierarchy(shape[0], table, scale, coarser, memory)


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


def _new_arrays(like: Tensor, shape: Sequence[int], count: int) -> Tensor:
    """So many arrays beside each other, each after a margin of zeros, with another behind all."""
    before, cells = margin(shape[-1]), math.prod(shape)
    size = room(cells, shape[-1])
    block = like.new_empty(count * size + before)
    rows = block[: count * size].view(count, size)
    rows[:, :before] = block[-before:] = 0
    return rows[:, before : before + cells].view(count, *shape)


@functools.cache
def prepare_kernel(bits: int) -> TextKernel:
    """Steps of making a hierarchy, each of one of the parts of its rows."""
    text = "prepare<F>({table, {}}, colors, first, last, item, parts, sums + 3 * item);"
    given = "long *table; int colors, first, last, parts; double *sums"
    return TextKernel("prepare", bits, text, given, "sums", f"{ROOM}/prepare.h")
