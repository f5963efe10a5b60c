"""A hierarchy of grids in the memory of fused kernels."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.operator import AXES, Operator, lower_cells
from ddrecon.diffusion.solvers.fused.kernels import MAKING, prepare_kernel
from ddrecon.diffusion.solvers.fused.stages import (
    MATRIX,
    Axes,
    Shape,
    Stages,
    first_guess,
    stages_of,
    strong_axes,
)
from ddrecon.diffusion.solvers.hierarchy import Coarsest
from ddrecon.kernels.launch import thread_count

SMALL = 30_000
"""So few cells, of all colors, are best done by one thread."""
_last_axes: dict[tuple[Shape, int], Axes] = {}
"""What hierarchies of a shape and so many colors coarsened last: where the next begins to try.

It is checked, so no result depends on it.
"""


@dataclass(eq=False)
class Hierarchy:
    """The grids of an operator: numbers `data`, laid out as `stages` say.

    Which axes are strong is known only with the conductances of each level: `strengths`. So a
    hierarchy is made with the axes of the last one of its shape, and made anew where these were
    wrong. `shares`: of a color, so that threads have equally many.
    """

    stages: Stages
    shares: int
    data: Tensor
    strengths: Tensor

    @staticmethod
    def of(operator: Operator) -> Hierarchy:
        """All grids of `operator`."""
        shape, colors = shape_of(operator)
        made = make(operator, _last_axes.get((shape, colors), first_guess(shape)))
        while (axes := strong_axes(shape, made.axes, made.means())) != made.axes:
            made = make(operator, axes)
        _last_axes[shape, colors] = axes
        return made

    @property
    def scale(self) -> Tensor:
        """S of the finest grid [matrices, z, y, x] (a view)."""
        return self.stages.view(self.data, 0, "SCALE", self.stages.shape(0))

    @property
    def axes(self) -> Axes:
        """The axes that each level coarsens."""
        return self.stages.axes

    def means(self) -> list[list[float]]:
        """The mean scaled conductance along each axis, of each level that is coarsened."""
        strengths, found, begin = self.strengths.tolist(), [], 0
        for number, stage in enumerate(self.stages.levels[: len(self.axes)]):
            shape = self.stages.shape(stage)
            end = begin + 3 * self.stages.colors * (self.shares if number == 0 else 1)
            sums = [math.fsum(strengths[begin + axis : end : 3]) for axis in range(3)]
            cells = self.stages.colors * math.prod(shape)
            found.append(
                [s * n / (cells * max(n - 1, 1)) for s, n in zip(sums, shape, strict=True)]
            )
            begin = end
        return found


def shares_of(cells: int, colors: int, like: Tensor) -> tuple[int, int]:
    """Into how many shares a color's slices are cut, and how many threads work on those of all."""
    threads = thread_count(like) if cells * colors > SMALL else 1
    return threads // math.gcd(threads, colors), threads


@functools.cache
def table_of(stages: Stages) -> Tensor:
    """The table of `stages` for kernels."""
    return torch.tensor(stages.table, dtype=torch.int64)


def shape_of(operator: Operator) -> tuple[Shape, int]:
    """Cells along z, y and x, and how many matrices there are."""
    z, y, x = operator.loss.shape[1:]
    return (z, y, x), max(len(tensor) for tensor in (operator.loss, *operator.conductances))


def make(operator: Operator, axes: Axes) -> Hierarchy:
    """The grids of `operator` that come about by coarsening these `axes`."""
    shape, colors = shape_of(operator)
    stages, loss = stages_of(shape, colors, axes), operator.loss
    shares, threads = shares_of(math.prod(shape), colors, loss)
    levels = len(stages.levels) - 1
    data, work = loss.new_empty(stages.data), loss.new_empty(stages.work)
    strengths = loss.new_empty(3 * colors * (shares + max(levels - 1, 0)), dtype=torch.float64)
    made = {
        "data": data,
        "work": work,
        "scratch": loss.new_empty(colors * shares * 3 * (shape[2] + 3)),
        "strengths": strengths,
    }
    given: dict[str, Any] = {"table": table_of(stages), "colors": colors}
    given["finest_parts"] = shares
    matrix = *operator.conductances, loss
    given |= {"matrix": matrix, "is_each": [len(tensor) == colors for tensor in matrix]}
    kernel = prepare_kernel(loss.element_size() * 8).bind(given, made)

    def do(step: str, stage: int, parts: int, threads: int) -> None:
        kernel.launch(colors * parts, threads, step=MAKING[step], stage=stage, parts=parts)

    hierarchy = Hierarchy(stages, shares, data, strengths)
    do("SCALE_CELLS", 0, shares, threads)
    do("SCALE_FACES", 0, shares, threads)
    second = stages.levels[1] if levels else 0
    for stage in range(second):
        do("WEIGHTS", stage, shares, threads)
        do("COARSE_CELLS", stage, shares, threads)
    if levels:
        do("ALL_BUT_FIRST", second, 1, min(threads, colors))
        last = stages.levels[-1]
        cells = stages.shape(last)
        few = math.prod(cells)
        # Faces lie at the cell below them.
        *faces, lost = (stages.view(work, last, name, cells) for name in MATRIX)
        z, y, x = (lower_cells(c, axis) for axis, c in zip(AXES, faces, strict=True))
        inverse = Coarsest.of(Operator((z, y, x), lost)).inverse
        stages.view(data, last, "INVERSE", (few, few)).copy_(inverse)
    return hierarchy
