"""Launches of kernels that sweep discrete ordinates (`ordinates.h`), forward and back.

By rows, on a processor, a launch does some planes of a chunk of ordinates, with each team once
along z and once against it. They meet in the middle, where each goes on in the next launch: so no
two write to the same cells at once. By cells, on a GPU, a launch does one slice of all ordinates of
a chunk, and products of matrices sum over these.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.launch import count_shares, launch_later
from ddrecon.kernels.text import Bound, TextKernel, names_of
from ddrecon.transport.fused.ordinates import Chunk, ordinate_tables

GIVEN = (
    "int *teams, *ordinates; F *paths, *values, *weighted, *ones, *scales, *extinction, *densest,"
    "*scattering, *gradient, *source, *bars, *d_scales, *d_extinction, *d_scattering, *d_gradient,"
    "*d_source, *entering, *light, *returning, *scratch, *outputs, *moments, *gradient_bar, *e_bar,"
    "*sc_bar; double *inflow_bar; int depth, height, width, periodic, count, colors, extinctions,"
    "scatterings, planes, back_planes, pitch, most, first, launched, team, color, together, lanes,"
    "begin, end"
)
"""What the struct `Sweep` of `ordinates.h` holds."""
MADE = "light returning scratch outputs moments gradient_bar e_bar sc_bar inflow_bar"
"""What of that kernels write."""
VECTOR = 16
"""Rows of numbers begin at multiples of so many."""
ROWS, OUTPUTS = 7, 4
"""Rows of scratch for a team besides those of moments and ordinates; what an ordinate gives."""
CELL = ROWS + 2
"""Numbers of scratch for a cell."""
TABLES = "teams", "ordinates", "paths", "values", "weighted", "ones"
SLAB = 4
"""Planes of which I is kept for the adjoint at most; before each slab it is saved."""
Ordinates = tuple[Grid, int, int | None]
"""A grid, how many directions cross it, and which chunk of them; None for all."""


@dataclass(frozen=True)
class Swept:
    """What a sweep depends on.

    `scales` [3, C]: factors of the fields `extinction` and `scattering` [1 or C, z, y, x], and the
    inflow; `gradient` [3, C, z, y, x] and `source` [K, C, z, y, x] as of `transport.sweep`.
    """

    scales: Tensor
    extinction: Tensor
    scattering: Tensor
    gradient: Tensor
    source: Tensor


class Sweep:
    """A sweep of what is `swept`, or its change by `d_swept`.

    With a chunk it is of those ordinates alone, and light enters and leaves by faces: by cells.
    """

    def __init__(self, of: Ordinates, swept: Swept, d_swept: Swept | None = None):
        grid, directions, chunk = of
        self.swept, self.d_swept, self.like, self.grid = swept, d_swept, swept.source, grid
        self.has_faces = chunk is not None
        self.by_rows = not (self.like.is_cuda or self.has_faces)
        self.count, self.colors = self.like.shape[:2]
        self.together, self.lanes, self.pieces = self.colors, 1, 1
        if self.by_rows:
            threads = torch.get_num_threads()
            self.together = max(1, min(threads // 2, self.colors))
            copied = self.like.element_size() * self.like[0].numel() * (self.count + 5)
            self.pieces = count_shares(max(1, threads // (2 * self.colors)), copied, 1)
            tables = ordinate_tables(grid, directions, self.like, self.count, self.pieces)
        else:
            _, second, largest = sorted(grid.shape)
            self.lanes = second * largest
            tables = ordinate_tables(grid, directions, self.like, self.count)
        self.tables, self.densest = tables, swept.extinction.amax(-1)
        self.chunks = tables.chunks if chunk is None else [tables.chunks[chunk]]

    def follow(
        self, saves: bool = False, entering: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """Moments of radiance [K, C, z, y, x], or their change; and what `go_back` is to get.

        By rows, if it `saves`, that is light before each stage, [stages, ordinates, C, plane].
        With faces the second is light where it leaves cells, a ring like `entering`: what enters
        them from outside.
        """
        stages, moments, saved = self._stages(), self._sums(self.count), None
        planes = 2 if self.by_rows else self._all_planes
        if saves and self.by_rows:
            shape = len(stages), len(self.tables.numbers), self.colors, *self._plane
            saved = self.like.new_empty(shape)
        for call in ("follow<true>()", "go_back()") if saves else ():
            launch_later(self._kernel(call).kernel, self.like)
        for chunk, colors in self._parts():
            light, outputs = self._ring(chunk, colors, planes), self._outputs(chunk, 1)
            arrays = {"light": light, "moments": moments, "outputs": outputs}
            given = {"planes": planes, "entering": entering}
            bound = self._bind("follow<false>()", chunk, colors, arrays, given)
            for number, stage in enumerate(stages):
                if saved is not None:
                    saved[number, chunk.ordinates, colors] = light[:, :, (stage.start - 1) % planes]
                self._launch(bound, chunk, colors, stage)
            self._sum_outputs(chunk, outputs, ["weighted"], [moments])
        return _total(moments), light if self.has_faces else saved

    def go_back(
        self,
        bars: Tensor,
        saved: Tensor | None,
        entering: Tensor | None = None,
        leaving: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Cotangents of inflow [C], extinction and scattering [C, z, y, x], gradient and source.

        Those of extinction and scattering are by these themselves [1/u]. `bars`: of moments
        [K, C, z, y, x]; `saved` and `entering`: as of `follow`; `leaving`: the cotangent of its
        light, of which that of what enters is made.
        """
        stages, inflow = self._stages(), self.like.new_zeros(self.colors, dtype=torch.float64)
        sums = source, gradient, mass, scattered = (*map(self._sums, (self.count, 3, 1, 1)),)
        planes, back_planes = (SLAB + 1, 2) if self.by_rows else (self._all_planes,) * 2
        for chunk, colors in self._parts():
            light, outputs = self._ring(chunk, colors, planes), self._outputs(chunk, OUTPUTS)
            returning = self._ring(chunk, colors, back_planes) if leaving is None else leaving
            items = chunk.teams * (colors.stop - colors.start) * self.lanes
            entered = self.like.new_zeros(items, dtype=torch.float64)
            arrays = {
                "light": light, "returning": returning, "outputs": outputs, "inflow_bar": entered,
                "moments": source, "gradient_bar": gradient, "e_bar": mass, "sc_bar": scattered,
            }  # fmt: skip
            given = {"planes": planes, "back_planes": back_planes, "bars": bars}
            given |= {"entering": entering}
            follow, go_back = (
                self._bind(call, chunk, colors, arrays, given)
                for call in ("follow<true>()", "go_back()")
            )
            if not self.by_rows:
                for stage in stages:
                    self._launch(follow, chunk, colors, stage)
            for number, stage in reversed(list(enumerate(stages))):
                if saved is not None and self.by_rows:
                    light[:, :, (stage.start - 1) % planes] = saved[number, chunk.ordinates, colors]
                    self._launch(follow, chunk, colors, stage)
                self._launch(go_back, chunk, colors, stage)
            self._sum_outputs(chunk, outputs, ["values", "moved", "ones", "ones"], sums)
            inflow[colors] += entered.view(chunk.teams, -1, self.lanes).sum((0, 2))
        totals = [_total(one) for one in (mass, scattered, gradient, source)]
        return inflow.to(self.like), totals[0][0], totals[1][0], *totals[2:]

    @property
    def _plane(self) -> tuple[int, int]:
        """Rows and columns of a plane with its rim."""
        return self.grid.shape[1] + 2, self.grid.shape[2] + 2

    @property
    def _all_planes(self) -> int:
        """In rings that keep all: those before and, with faces, behind the grid as well."""
        return self.grid.shape[0] + 1 + self.has_faces

    def _parts(self) -> Iterator[tuple[Chunk, slice]]:
        """Ordinates and colors swept side by side."""
        for chunk in self.chunks:
            for color in range(0, self.colors, self.together):
                yield chunk, slice(color, min(color + self.together, self.colors))

    def _stages(self) -> list[range]:
        """Planes, or the slice, of each launch, counted from where light enters."""
        depth = self.grid.shape[0]
        if not self.by_rows:
            return [range(s, s + 1) for s in range(max(self.grid.shape) + self.has_faces)]
        half = depth // 2
        # The plane in the middle, if there is one, is a stage of its own.
        bounds = [
            *range(0, half, SLAB), *range(half, depth - half), *range(depth - half, depth, SLAB)
        ]  # fmt: skip
        return [range(*pair) for pair in zip(bounds, [*bounds[1:], depth], strict=True)]

    def _sums(self, count: int) -> Tensor:
        return self.like.new_zeros(self.pieces, count, *self.like.shape[1:])

    def _ring(self, chunk: Chunk, colors: slice, planes: int) -> Tensor:
        """Planes of numbers, [ordinates, colors, planes, plane]; of changes, with these behind."""
        kinds = () if self.d_swept is None else (2,)
        together = colors.stop - colors.start
        return self.like.new_zeros(chunk.count, together, planes, *kinds, *self._plane)

    def _outputs(self, chunk: Chunk, count: int) -> Tensor | None:
        """What ordinates give in each cell; by rows it is summed at once."""
        if self.by_rows:
            return None
        return self.like.new_empty(count, chunk.count, *self.like.shape[1:])

    def _sum_outputs(
        self, chunk: Chunk, outputs: Tensor | None, tables: Sequence[str], sums: Sequence[Tensor]
    ) -> None:
        """Adds outputs of ordinates, times `tables` of these names, to `sums`."""
        if outputs is None:
            return
        for output, table, (total,) in zip(outputs, tables, sums, strict=True):
            matrix = self.tables.arrays[table][chunk.ordinates]
            total.view(len(total), -1).addmm_(matrix.T, output.view(chunk.count, -1))

    def _bind(
        self,
        call: str,
        chunk: Chunk,
        colors: slice,
        arrays: dict[str, Any],
        given: dict[str, Any],
    ) -> Bound:
        swept, changes, tables = self.swept, self.d_swept, self.tables
        depth, height, width = self.grid.shape
        together, pitch = colors.stop - colors.start, math.ceil(width / VECTOR) * VECTOR
        if self.by_rows:
            rows = ROWS + 2 * self.count + (2 + OUTPUTS) * tables.most
            scratch = self.like.new_empty(chunk.teams * together * rows * pitch)
            arrays = arrays | {"scratch": scratch}
        names = "scales", "extinction", "scattering", "gradient", "source"
        fields = {name: getattr(swept, name) for name in names}
        d_fields = {f"d_{name}": changes and getattr(changes, name) for name in names}
        kernel = self._kernel(call)
        given = (
            dict.fromkeys(kernel.names - kernel.made, 0)
            | dict.fromkeys(kernel.arrays.keys() - kernel.made)
            | given
        )
        return kernel.bind(
            given | fields | d_fields | {name: tables.arrays[name] for name in TABLES} | {
                "densest": self.densest, "depth": depth, "height": height, "width": width,
                "periodic": sum(2**axis for axis in self.grid.periodic), "count": self.count,
                "colors": self.colors, "extinctions": len(swept.extinction),
                "scatterings": len(swept.scattering), "pitch": pitch, "most": tables.most,
                "first": chunk.first, "launched": chunk.count * together, "team": chunk.team,
                "color": colors.start, "together": together, "lanes": self.lanes,
                "back_planes": given["back_planes"] or 1,
            },
            dict.fromkeys(kernel.made) | arrays,
        )  # fmt: skip

    def _kernel(self, call: str) -> TextKernel:
        is_dual, bits = self.d_swept is not None, 8 * self.like.itemsize
        return _kernel(call, is_dual, self.by_rows, self.has_faces, bits)

    def _launch(self, bound: Bound, chunk: Chunk, colors: slice, stage: range) -> None:
        items, threads = chunk.teams * (colors.stop - colors.start) * self.lanes, None
        if self.by_rows:
            # Teams that meet in the middle of an odd number of planes do it one after another.
            is_middle = 2 * stage.start + 1 == self.grid.shape[0]
            threads = 1 if is_middle else min(items, torch.get_num_threads())
        bound.launch(items, threads, begin=stage.start, end=stage.stop)


def _total(sums: Tensor) -> Tensor:
    """The sum over pieces."""
    return sums[0] if len(sums) == 1 else sums.sum(0)


@functools.cache
def _kernel(call: str, is_dual: bool, by_rows: bool, has_faces: bool, bits: int) -> TextKernel:
    """The kernel that calls a member function of `Ordinates`."""
    number, kind = "Dual<F>" if is_dual else "F", "BY_ROWS" if by_rows else "CELLS"
    text = f"F cell[{CELL}]; const Sweep<F> of = {{{names_of(GIVEN)}}};"
    text += f"Ordinates<{number}, F, {'FACES' if has_faces else kind}>(item, of, cell).{call};"
    name = "ordinates_" + call.split("<")[0].removesuffix("()")
    return TextKernel(name, bits, text, GIVEN, MADE, "transport/fused/ordinates.h")
