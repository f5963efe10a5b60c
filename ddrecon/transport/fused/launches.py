"""Launches of kernels that sweep discrete ordinates (`ordinates.h`), forward and back.

By rows, on a processor, a launch does some planes of a chunk of ordinates, with each team once
along z and once against it. They meet in the middle, where each goes on in the next launch: so no
two write to the same cells at once. By cells, on a GPU, a launch does one slice of all ordinates of
a chunk, and products of matrices sum over these.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.launch import count_shares
from ddrecon.kernels.text import Bound, TextKernel, names_of
from ddrecon.transport.fused.ordinates import Chunk, make_tables

GIVEN = (
    "int *teams, *ordinates; F *paths, *values, *weighted, *ones, *scales, *extinction, *densest,"
    "*scattering, *gradient, *source, *bars, *d_scales, *d_extinction, *d_scattering, *d_gradient,"
    "*d_source, *light, *returning, *scratch, *outputs, *moments, *gradient_bar, *e_bar, *sc_bar;"
    "double *inflow_bar; int depth, height, width, count, colors, extinctions, scatterings, planes,"
    "back_planes, pitch, most, first, launched, team, color, together, lanes, begin, end"
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
FILL = 2**18
"""Cells of slices in a launch by cells: about as many threads as a GPU holds."""


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
    """A sweep of `directions` through `grid` of what is `swept`, or its change by `d_swept`."""

    def __init__(self, grid: Grid, directions: int, swept: Swept, d_swept: Swept | None = None):
        self.swept, self.d_swept, self.like = swept, d_swept, swept.source
        self.by_rows, self.shape = not self.like.is_cuda, grid.shape
        self.count, self.colors = self.like.shape[:2]
        _, second, largest = sorted(grid.shape)
        if self.by_rows:
            self.threads, self.lanes = torch.get_num_threads(), 1
            self.together = max(1, min(self.threads // 2, self.colors))
            copied = self.like.element_size() * self.like[0].numel() * (self.count + 5)
            self.pieces = count_shares(max(1, self.threads // (2 * self.colors)), copied, 1)
            size = self.pieces
        else:
            self.threads, self.lanes = 1, second * largest
            self.together, self.pieces = self.colors, 1
            size = math.ceil(FILL / (self.colors * self.lanes))
        self.tables = make_tables(
            grid, directions, self.count, self.by_rows, size, self.like.dtype, self.like.device
        )
        self.densest = swept.extinction.amax(-1)

    def follow(self, saves: bool = False) -> tuple[Tensor, Tensor | None]:
        """Moments of radiance [K, C, z, y, x], or their change; what `go_back` needs if it `saves`.

        By rows that is light before each stage, [stages, ordinates, C, plane]; else None.
        """
        stages, moments = self._stages(), self._sums(self.count)
        saved = None
        if saves and self.by_rows:
            plane = (self.shape[1] + 2) * (self.shape[2] + 2)
            ordinates = len(self.tables.numbers)
            saved = self.like.new_empty(len(stages), ordinates, self.colors, plane)
        planes = 2 if self.by_rows else self.shape[0] + 1
        for chunk, colors in self._parts():
            arrays = {"light": self._ring(chunk, colors, planes), "moments": moments}
            arrays["outputs"] = self._outputs(chunk, colors, 1)
            bound = self._bind("follow<false>()", chunk, colors, arrays, {"planes": planes})
            for number, stage in enumerate(stages):
                if saved is not None:
                    kept = saved[number, chunk.ordinates, colors]
                    kept.copy_(arrays["light"][:, :, (stage.start - 1) % planes])
                self._launch(bound, chunk, colors, stage)
            self._sum_cells(chunk, arrays["outputs"], {"weighted": moments})
        return moments.sum(0), saved

    def go_back(self, bars: Tensor, saved: Tensor | None) -> tuple[Tensor, ...]:
        """Cotangents of inflow [C], extinction and scattering [C, z, y, x], gradient and source.

        `bars`: of moments [K, C, z, y, x]; `saved`: by `follow`. Those of extinction and scattering
        are by these themselves [1/u].
        """
        stages, inflow = self._stages(), self.like.new_zeros(self.colors, dtype=torch.float64)
        source, gradient, mass, scattered = (self._sums(n) for n in (self.count, 3, 1, 1))
        planes, back_planes = (SLAB + 1, 2) if self.by_rows else (self.shape[0] + 1,) * 2
        for chunk, colors in self._parts():
            items = chunk.teams * (colors.stop - colors.start), self.lanes
            arrays = {
                "light": self._ring(chunk, colors, planes),
                "returning": self._ring(chunk, colors, back_planes),
                "outputs": self._outputs(chunk, colors, OUTPUTS),
                "inflow_bar": self.like.new_zeros(items, dtype=torch.float64),
                "moments": source, "gradient_bar": gradient, "e_bar": mass, "sc_bar": scattered,
            }  # fmt: skip
            given = {"planes": planes, "back_planes": back_planes, "bars": bars}
            follow, go_back = (
                self._bind(call, chunk, colors, arrays, given)
                for call in ("follow<true>()", "go_back()")
            )
            if saved is None:
                for stage in stages:
                    self._launch(follow, chunk, colors, stage)
            for number, stage in reversed(list(enumerate(stages))):
                if saved is not None:
                    kept = saved[number, chunk.ordinates, colors]
                    arrays["light"][:, :, (stage.start - 1) % planes] = kept
                    self._launch(follow, chunk, colors, stage)
                self._launch(go_back, chunk, colors, stage)
            sums = {"values": source, "moved": gradient, "ones": mass, "ones ": scattered}
            self._sum_cells(chunk, arrays["outputs"], sums)
            inflow[colors] += arrays["inflow_bar"].view(chunk.teams, -1, self.lanes).sum((0, 2))
        return inflow.to(self.like), *(
            one.sum(0) for one in (mass[:, 0], scattered[:, 0], gradient, source)
        )

    def _parts(self) -> Iterator[tuple[Chunk, slice]]:
        """Ordinates and colors swept side by side."""
        for chunk in self.tables.chunks:
            for color in range(0, self.colors, self.together):
                yield chunk, slice(color, min(color + self.together, self.colors))

    def _stages(self) -> list[range]:
        """Planes, or the slice, of each launch, counted from where light enters."""
        depth = self.shape[0]
        if not self.by_rows:
            return [range(s, s + 1) for s in range(max(self.shape))]
        half = depth // 2
        # The plane in the middle, if there is one, is a stage of its own.
        bounds = [
            *range(0, half, SLAB),
            *range(half, depth - half),
            *range(depth - half, depth, SLAB),
        ]
        return [range(*pair) for pair in zip(bounds, [*bounds[1:], depth], strict=True)]

    def _sums(self, count: int) -> Tensor:
        return self.like.new_zeros(self.pieces, count, *self.like.shape[1:])

    def _ring(self, chunk: Chunk, colors: slice, planes: int) -> Tensor:
        """Numbers in planes with a rim, [ordinates, colors, planes, plane], or also changes."""
        plane = (1 if self.d_swept is None else 2) * (self.shape[1] + 2) * (self.shape[2] + 2)
        return self.like.new_zeros(chunk.count, colors.stop - colors.start, planes, plane)

    def _outputs(self, chunk: Chunk, colors: slice, count: int) -> Tensor | None:
        """What ordinates give in each cell; by rows they are summed at once."""
        if self.by_rows:
            return None
        return self.like.new_empty(count, chunk.count, *self.like.shape[1:])

    def _sum_cells(self, chunk: Chunk, outputs: Tensor | None, sums: dict[str, Tensor]) -> None:
        """Adds outputs of ordinates, times a table, to sums [1, count, C, z, y, x]."""
        if outputs is None:
            return
        for output, (name, total) in zip(outputs, sums.items(), strict=True):
            matrix = self.tables.arrays[name.strip()][chunk.ordinates]
            total[0].view(len(total[0]), -1).addmm_(matrix.T, output.view(chunk.count, -1))

    def _bind(
        self, call: str, chunk: Chunk, colors: slice, arrays: dict[str, Any], given: dict[str, Any]
    ) -> Bound:
        swept, changes, tables = self.swept, self.d_swept, self.tables
        depth, height, width = self.shape
        together = colors.stop - colors.start
        pitch = math.ceil(width / VECTOR) * VECTOR
        arrays = dict.fromkeys(MADE.split()) | arrays
        if self.by_rows:
            rows = ROWS + 2 * self.count + (2 + OUTPUTS) * tables.most
            arrays["scratch"] = self.like.new_empty(chunk.teams * together * rows * pitch)
        names = "scales", "extinction", "scattering", "gradient", "source"
        fields = {name: getattr(swept, name) for name in names}
        d_fields = {f"d_{name}": changes and getattr(changes, name) for name in names}
        tables_given = {name: tables.arrays[name] for name in TABLES}
        kernel = _kernel(call, changes is not None, self.by_rows, 8 * self.like.itemsize)
        return kernel.bind(
            {"bars": None, "back_planes": 1} | tables_given | fields | d_fields | given | {
                "densest": self.densest, "depth": depth, "height": height, "width": width,
                "count": self.count, "colors": self.colors, "extinctions": len(swept.extinction),
                "scatterings": len(swept.scattering), "pitch": pitch, "most": tables.most,
                "first": chunk.first, "launched": chunk.count * together, "team": chunk.team,
                "color": colors.start, "together": together, "lanes": self.lanes, "begin": 0,
                "end": 0,
            },
            arrays,
        )  # fmt: skip

    def _launch(self, bound: Bound, chunk: Chunk, colors: slice, stage: range) -> None:
        items = chunk.teams * (colors.stop - colors.start) * self.lanes
        # Teams that meet in the middle of an odd number of planes do it one after another.
        is_middle = self.by_rows and 2 * stage.start + 1 == self.shape[0]
        threads = 1 if is_middle else min(items, self.threads)
        bound.launch(items, threads, begin=stage.start, end=stage.stop)


@functools.cache
def _kernel(call: str, is_dual: bool, by_rows: bool, bits: int) -> TextKernel:
    """The kernel that calls a member function of `Ordinates`."""
    number, by_cells = "Dual<F>" if is_dual else "F", str(not by_rows).lower()
    text = f"F cell[{CELL}]; const Sweep<F> of = {{{names_of(GIVEN)}}};"
    text += f"Ordinates<{number}, F, {by_cells}>(item, of, cell).{call};"
    name = "ordinates_" + call.split("<")[0].removesuffix("()")
    return TextKernel(name, bits, text, GIVEN, MADE, "transport/fused/ordinates.h")
