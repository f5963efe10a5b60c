"""A sweep as one differentiable function of tensors, by fused kernels (`ordinates.h`; E2.9, E2.8).

By rows, on a processor, a launch does some planes of a chunk of ordinates, with each team once
along z and once against it. They meet in the middle, where each goes on in the next launch: so no
two write to the same cells at once. By cells, on a GPU and where light enters by faces, a launch
does one slice of all ordinates of a chunk, and products of matrices sum over moments and
ordinates.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.cell_function import RowFunction
from ddrecon.kernels.launch import count_shares, launch_later
from ddrecon.kernels.text import TextKernel, members_of, names_of
from ddrecon.medium.coefficients import Medium, remaining_moments
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly
from ddrecon.transport.fused.ordinates import Chunk, ordinate_tables

HEADER = "transport/fused/ordinates.h"
WRITTEN = "light returning scratch outputs sums gradient_bar extinction_bar"
"""What of the struct `Sweep` kernels write."""
TABLES = "teams", "ordinates", "paths", "values", "weighted"
VECTOR = 16
"""Rows of numbers begin at multiples of so many."""
ROWS = 7
"""Rows of scratch for a team besides those of moments and ordinates."""
SLAB = 4
"""Planes of which I is kept for the adjoint at most; before each slab it is saved."""
Ordinates = tuple[Grid, int, int | None]
"""A grid, how many directions cross it, and which chunk of them, by cells; None: all, by rows."""
Fields = tuple[Tensor, Tensor, Tensor]
"""What a sweep depends on: extinction [C, z, y, x], the moments [K, C, z, y, x] of what cells emit,
of a chunk what they emit along each ordinate's path [ordinates, C, z, y, x], and its gradient
[3, C, z, y, x] from cell to cell.
"""
FIELDS = "extinction", "source", "gradient"
"""Their names in kernels."""


class _Launches:
    """Kernels that sweep what stands in `fields`, or its change by `d_fields`."""

    def __init__(self, of: Ordinates, fields: Fields, d_fields: Fields | None = None):
        self.grid, directions, self.chunk = of
        self.fields, self.d_fields, self.like = fields, d_fields, fields[1]
        self.by_rows = self.chunk is None
        self.count, self.colors = self.like.shape[:2]
        self.together, self.lanes, self.pieces = self.colors, 1, 1
        if self.by_rows:
            threads = torch.get_num_threads()
            self.together = max(1, min(threads // 2, self.colors))
            copied = self.like.element_size() * self.like[0].numel() * (self.count + 4)
            self.pieces = count_shares(max(1, threads // (2 * self.colors)), copied, 1)
        else:
            _, second, largest = sorted(self.grid.shape)
            self.lanes = second * largest
        pieces = self.pieces if self.by_rows else None
        moments = self.count if self.by_rows else 1
        self.tables = ordinate_tables(self.grid, directions, self.like, moments, pieces)
        # Rows and columns of a plane with its rim.
        self.plane = self.grid.shape[1] + 2, self.grid.shape[2] + 2

    def ring(self, chunk: Chunk, colors: slice, planes: int) -> Tensor:
        """Planes of numbers, [ordinates, colors, planes, plane]; of changes, with these behind."""
        kinds = () if self.d_fields is None else (2,)
        together = colors.stop - colors.start
        return self.like.new_zeros(chunk.count, together, planes, *kinds, *self.plane)

    def kernel(self, run: str) -> TextKernel:
        """The kernel of a `run` of `Ordinates`."""
        return _kernel(run, self.d_fields is not None, self.by_rows, 8 * self.like.itemsize)

    def bind(
        self, run: str, chunk: Chunk, colors: slice, **arrays: Tensor | None
    ) -> Callable[[range], None]:
        """The kernel of a `run`, given these `arrays`, as a function of planes, or of a slice."""
        kernel, tables, together = self.kernel(run), self.tables, colors.stop - colors.start
        depth, height, width = self.grid.shape
        pitch, room = math.ceil(width / VECTOR) * VECTOR, ROWS + self.count + 2 * tables.most
        items = chunk.teams * together * self.lanes
        if self.by_rows:
            arrays["scratch"] = self.like.new_empty(items * room * pitch)
        planes, back_planes = (
            1 if ring is None else ring.shape[2] for ring in map(arrays.get, ("light", "returning"))
        )
        changes = self.d_fields or (None,) * len(FIELDS)
        inputs = dict.fromkeys(kernel.arrays) | dict(zip(FIELDS, self.fields, strict=True))
        inputs |= {f"d_{name}": change for name, change in zip(FIELDS, changes, strict=True)}
        inputs |= {name: tables.arrays[name] for name in TABLES} | arrays
        outputs = {name: inputs.pop(name) for name in kernel.written}
        numbers = {
            "depth": depth, "height": height, "width": width, "planes": planes,
            "back_planes": back_planes, "periodic": sum(2**axis for axis in self.grid.periodic),
            "count": self.count, "colors": self.colors, "pitch": pitch, "room": room,
            "first": chunk.first, "launched": chunk.count * together, "team": chunk.team,
            "color": colors.start, "together": together, "lanes": self.lanes, "begin": 0, "end": 0,
        }  # fmt: skip
        bound = kernel.bind(inputs | numbers, outputs)

        def launch(stage: range) -> None:
            threads = None
            if self.by_rows:
                # Teams that meet in the middle of an odd number of planes do it one after another.
                is_middle = 2 * stage.start + 1 == depth
                threads = 1 if is_middle else min(items, torch.get_num_threads())
            bound.launch(items, threads, begin=stage.start, end=stage.stop)

        return launch


class _ByRows(_Launches):
    """All ordinates, of which light enters by no face."""

    def follow(self, _: None, saves: bool = False) -> tuple[Tensor, Tensor | None]:
        """Moments of radiance [K, C, z, y, x], or their change; and what `go_back` is to get.

        If it `saves`, that is light before each stage, [stages, ordinates, C, plane].
        """
        stages, moments, saved = self._stages(), self._sums(self.count), None
        if saves:
            shape = len(stages), len(self.tables.numbers), self.colors, *self.plane
            saved = self.like.new_empty(shape)
            for run in ("LIGHT", "BACK"):
                launch_later(self.kernel(run).kernel, self.like)
        for chunk, colors in self._shares():
            light = self.ring(chunk, colors, 2)
            follow = self.bind("MOMENTS", chunk, colors, light=light, sums=moments)
            for number, stage in enumerate(stages):
                if saved is not None:
                    saved[number, chunk.ordinates, colors] = light[:, :, (stage.start - 1) % 2]
                follow(stage)
        return _total(moments), saved

    def go_back(self, bars: Tensor, saved: Tensor, *_: None) -> tuple[Tensor | None, ...]:
        """Cotangents of `fields`, of those of moments, `bars`, and what `follow` has saved."""
        counts = 1, self.count, 3
        totals = extinction, source, gradient = (*map(self._sums, counts),)
        planes, stages = SLAB + 1, list(enumerate(self._stages()))
        for chunk, colors in self._shares():
            light = self.ring(chunk, colors, planes)
            arrays = {
                "light": light, "returning": self.ring(chunk, colors, 2), "bars": bars,
                "extinction_bar": extinction, "gradient_bar": gradient, "sums": source,
            }  # fmt: skip
            follow, go_back = (self.bind(run, chunk, colors, **arrays) for run in ("LIGHT", "BACK"))
            for number, stage in reversed(stages):
                light[:, :, (stage.start - 1) % planes] = saved[number, chunk.ordinates, colors]
                follow(stage)
                go_back(stage)
        extinction_bar, *fields_bar = map(_total, totals)
        return extinction_bar[0], *fields_bar, None

    def _shares(self) -> Iterator[tuple[Chunk, slice]]:
        """Ordinates and colors swept side by side."""
        for chunk in self.tables.chunks:
            for color in range(0, self.colors, self.together):
                yield chunk, slice(color, min(color + self.together, self.colors))

    def _stages(self) -> list[range]:
        """Planes of each launch, counted from where light enters."""
        depth = self.grid.shape[0]
        half = depth // 2
        # The plane in the middle, if there is one, is a stage of its own.
        bounds = [
            *range(0, half, SLAB), *range(half, depth - half), *range(depth - half, depth, SLAB)
        ]  # fmt: skip
        return [range(*pair) for pair in zip(bounds, [*bounds[1:], depth], strict=True)]

    def _sums(self, count: int) -> Tensor:
        return self.like.new_zeros(self.pieces, count, *self.like.shape[1:])


def _total(sums: Tensor) -> Tensor:
    """The sum over pieces."""
    return sums[0] if len(sums) == 1 else sums.sum(0)


class _ByCells(_Launches):
    """A chunk of ordinates, of which light may enter cells from outside: a ring like light."""

    def __init__(self, *of: Any):
        super().__init__(*of)
        assert self.chunk is not None
        self.all = self.tables.chunks[self.chunk], slice(0, self.colors)

    def follow(self, entering: Tensor | None, _: bool = False) -> tuple[Tensor, Tensor]:
        """Means of radiance [ordinates, C, z, y, x], and light that leaves cells; or changes."""
        # Planes behind the grid and, at the end of the ring, before it.
        light = self.ring(*self.all, self.grid.shape[0] + 2)
        means = self.like.new_empty(self.like.shape)
        follow = self.bind("MOMENTS", *self.all, light=light, outputs=means, entering=entering)
        for stage in self._slices(entering):
            follow(stage)
        return means, light

    def go_back(
        self, bars: Tensor, light: Tensor, entering: Tensor | None, light_bar: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        """Cotangents of `fields` and of what is `entering`, of those of means and `light`."""
        # The cotangent of what enters takes the place of that of light.
        returning = torch.zeros_like(light) if light_bar is None else light_bar.clone()
        outputs = source, rise, extinction = self.like.new_empty(3, *self.like.shape)
        rings: dict[str, Any] = {"light": light, "returning": returning, "outputs": outputs}
        go_back = self.bind("BACK", *self.all, **rings, bars=bars, entering=entering)
        for stage in reversed(self._slices(entering)):
            go_back(stage)
        gradient = torch.tensordot(self.tables.arrays["moved"][self.all[0].ordinates].T, rise, 1)
        return extinction.sum(0), source, gradient, None if entering is None else returning

    def _slices(self, entering: Tensor | None) -> list[range]:
        """The slice of each launch, and with faces what lies behind the last."""
        count = max(self.grid.shape) + (entering is not None)
        return [range(s, s + 1) for s in range(count)]


@functools.cache
def _kernel(run: str, is_dual: bool, by_rows: bool, bits: int) -> TextKernel:
    """The kernel of a `run` of `Ordinates`."""
    declared = members_of(HEADER, "Sweep")
    kind = f"Ordinates<{'Dual<F>' if is_dual else 'F'}, F, {str(not by_rows).lower()}>"
    text = f"F cell[{kind}::CELL]; const Sweep<F> of = {{{names_of(declared)}}};"
    text += f"{kind}(item, of, cell).run<{kind}::{run}>();"
    name = f"ordinates_{run.lower()}"
    return TextKernel(name, bits, text, declared, WRITTEN, HEADER)


def sweep_ordinates(
    of: Ordinates, fields: Fields, entering: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The moments [K, C, z, y, x] of radiance along ordinates `of` a quadrature set.

    Of a chunk it is the mean in cells along each ordinate [ordinates, C, z, y, x]. The second
    result is light where it leaves cells, a ring [ordinates, C, z + 2, y + 2, x + 2]
    (`ordinates.h`), and so is what is `entering` them.
    """
    tensors = *(field.contiguous() for field in fields), entering
    swept: tuple[Tensor, Tensor] = _Sweep.apply(of, torch.is_grad_enabled(), *tensors)
    return swept


class _Sweep(torch.autograd.Function):
    """Moments, or means; by rows what the backward pass needs, by cells light that leaves cells."""

    @staticmethod
    def forward(of: Ordinates, may_save: bool, *tensors: Any) -> tuple[Tensor, Tensor | None]:
        *fields, entering = tensors
        saves = may_save and any(field.requires_grad for field in fields)
        return _launches(of, fields).follow(entering, saves)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        ctx.of, _, *tensors = inputs
        if ctx.of[2] is None and output[1] is not None:
            ctx.mark_non_differentiable(output[1])
        ctx.set_materialize_grads(False)
        keep(ctx, *tensors, output[1])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bars: Tensor | None, light_bar: Tensor | None) -> tuple[Any, ...]:
        *fields, entering, light = ctx.saved_tensors
        bars = torch.zeros_like(fields[1]) if bars is None else bars.contiguous()
        return None, None, *_launches(ctx.of, fields).go_back(bars, light, entering, light_bar)

    @staticmethod
    def jvp(ctx: Any, *changes: Any) -> tuple[Tensor, Tensor | None]:
        def change(*tensors: Any) -> Any:
            values, d_values = tensors[:4], tensors[4:]
            *d_fields, d_entering = (
                value if value is None else torch.zeros_like(value) if d is None else d
                for value, d in zip(values, d_values, strict=True)
            )
            *fields, entering = values
            if entering is not None and d_entering is not None:
                entering = torch.stack([entering, d_entering], 3)
            moments, light = _launches(ctx.of, fields, d_fields).follow(entering)
            return moments if light is None else (moments, light[:, :, :, 1].contiguous())

        d_results = run_plainly(change, *ctx.saved_tensors[:4], *changes[2:])
        return d_results if isinstance(d_results, tuple) else (d_results, None)


def _launches(of: Ordinates, *fields: Any) -> Any:
    return (_ByRows if of[2] is None else _ByCells)(of, *fields)


def gain_fused(
    medium: Medium,
    change: Tensor,
    off: tuple[Tensor, Tensor | None] | None,
    cosine: Tensor,
    damping: float,
    step: tuple[float, float],
) -> tuple[Tensor, Tensor, Tensor | None]:
    """What of a sweep counts (E2.10, E2.8), as `_gain` in `rounds.py`.

    `step`: the mean one, by which theta is (E7.2).
    """
    extinction, scattering = medium.extinction.field, medium.remaining.field
    has_flux, (z, y, x) = len(change) > 1, medium.grid.shape
    is_so = has_flux, scattering is extinction, off is not None
    fields = [extinction] if scattering is extinction else [extinction, scattering]
    fields += [field for field in (change, *(off or ())) if field is not None]
    strength, moments = medium.remaining.scale, remaining_moments(medium)
    p_1 = moments[1] if len(moments) > 1 else torch.zeros_like(strength)
    length, shared = step
    depth, turned = length * medium.extinction.scale, length * p_1 * strength
    lag = torch.full_like(depth, shared)
    numbers = depth, lag, damping * depth, damping * turned, strength, cosine
    colors = max(*map(Tensor.numel, numbers), *(field.shape[-4] for field in fields))
    cells = colors, z, y, x
    function = RowFunction(
        "transport/fused/gain.h",
        f"Gain<{', '.join(str(int(flag)) for flag in is_so)}>",
        (cells, (len(change), *cells), *[(3, *cells)] * has_flux),
        y * x,
    )
    rows = torch.stack([number.reshape(-1).expand(colors) for number in numbers])
    source, gain, *more = function.apply(rows, *fields)
    return gain, source, more[0] if more else None
