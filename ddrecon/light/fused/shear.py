"""The mass that beams pass on their way to each cell, by fused kernels, and its derivatives.

Rays gather the field of all slices, one row of rays at a time; cells gather from rays. The same in
the other order for the adjoint: in no step do two items write to the same place.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.launch import launch_later
from ddrecon.kernels.text import TextKernel
from ddrecon.light import shear as plain
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly
from ddrecon.numerics.remember import remember
from ddrecon.numerics.slicing import Slicing, across

BACK = "carry_back", "sum_back", "look_back"
"""The kernels of the adjoint, in their order."""
BLOCK = 256
"""Neighbors in a row that one item does on a processor; on a GPU it is one."""


def sum_masses(
    field: Tensor, grid: Grid, directions: Tensor, bound: Tensor | float
) -> tuple[Tensor, Tensor]:
    """The mass [L, K, z, y, x] up to where each beam enters each cell, and its path in a slice [L].

    Arguments as of `light.shear.sum_masses`; differentiated in forward mode by `field` and `bound`
    alone.
    """
    shears, numbers = _cross(grid, directions)
    bounds = torch.as_tensor(bound).to(numbers).expand(len(numbers), 1)
    varied = field.requires_grad or numbers.requires_grad or bounds.requires_grad
    has_adjoint = torch.is_grad_enabled() and varied
    entered, *_ = _Masses.apply(shears, has_adjoint, field, numbers, bounds)
    return entered, numbers[:, 2]


@remember
def _cross(grid: Grid, directions: Tensor) -> tuple[tuple[Shear, ...], Tensor]:
    """How beams along `directions` [L, 3] cross slices, and the numbers [L, 3] of each.

    These are the slope by rows and by columns, and the path in a slice [u].
    """
    crossed = [plain.cross_grid(grid, direction) for direction in directions]
    shears = tuple(Shear(grid, slicing, slope) for slicing, slope, _ in crossed)
    return shears, torch.stack([torch.cat([slope, step[None]]) for _, slope, step in crossed])


class Shear:
    """How a beam of some `slope` (by rows, by columns) crosses the slices of `grid`.

    Kernels want the columns of slices beside each other in memory: `turn` sees to that, and brings
    cells back.
    """

    def __init__(self, grid: Grid, slicing: Slicing, slope: Tensor):
        self.is_across_x = slicing.axis == 2
        count, height, width = (grid.shape[a] for a in (slicing.axis, *across(slicing.axis)))
        rays = plain.Shear.of(count, (height, width), slope)
        # A row of one slice is followed by the same row of the next, but for slices across z.
        is_slices_first = slicing.axis != 0
        slice_stride, row_stride = (
            (width, count * width) if is_slices_first else (height * width, width)
        )
        window = (
            (width + 3) * (1 if is_slices_first else height + 3),
            (width + 3) * (count if is_slices_first else 1),
        )
        start = (count - 1) * slice_stride * slicing.is_reversed
        slice_stride *= -1 if slicing.is_reversed else 1
        sizes = count, height, width, *rays.lattice, *rays.first
        strides = start, slice_stride, row_stride, *window, is_slices_first
        self.record = dict(zip(_SLICES.split(", "), (*sizes, *strides), strict=True))
        self.window = count * (height + 3) * (width + 3)

    def turn(self, cells: Tensor) -> Tensor:
        """`cells` [K, z, y, x, ...] as kernels read and write them, and these as cells again."""
        return cells.transpose(2, 3).contiguous() if self.is_across_x else cells.contiguous()

    def launch(self, name: str, given: dict[str, Any], made: dict[str, Any]) -> None:
        """Runs a kernel for all rays, or all cells, of a `field`."""
        laid, record = given["field"], self.record
        lines, length = record["rows"], record["columns"]
        if not name.startswith("sum"):
            lines, length = record["slices"] * record["height"], record["width"]
        items = len(laid) * lines * math.ceil(length / (1 if laid.is_cuda else BLOCK))
        getattr(shear_kernels(laid.element_size() * 8), name).launch(items, record | given, made)


class _Masses(torch.autograd.Function):
    """The mass, and where it `has_adjoint` what that needs.

    Row l of `numbers` [L, 3] holds the slope of beam l by rows and by columns, and its path in a
    slice [u]; `bounds` [L, 1] are those of corrections.
    """

    @staticmethod
    def forward(
        shears: Sequence[Shear], has_adjoint: bool, field: Tensor, numbers: Tensor, bounds: Tensor
    ) -> tuple[Tensor, ...]:
        entered, laid = field.new_empty(len(shears), *field.shape), _lay(shears, field)
        kept, numbers = [], torch.cat([numbers, bounds], 1)
        for name in BACK if has_adjoint else ():
            launch_later(getattr(shear_kernels(8 * field.itemsize), name).kernel, field)
        for light, shear in enumerate(shears):
            given = {"light": light, "numbers": numbers, "field": laid[shear.is_across_x]}
            windows = field.new_empty(1 + has_adjoint, len(field) * shear.window)
            made = {"masses": windows[0], "corrections": windows[1] if has_adjoint else None}
            shear.launch("sum_along_rays", given, made)
            own = torch.empty_like(laid[True]) if shear.is_across_x else entered[light]
            shear.launch("carry_to_cells", given | made, {"entered": own})
            if shear.is_across_x:
                entered[light] = own.transpose(2, 3)
            kept += [windows] if has_adjoint else []
        return entered, *kept

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.shears, _, *tensors = inputs
        ctx.mark_non_differentiable(*output[1:])
        keep(ctx, *tensors, *output[1:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, entered_bar: Tensor, *_: Tensor) -> tuple[Any, ...]:
        field, numbers, bounds, *kept = ctx.saved_tensors
        laid, both = _lay(ctx.shears, field), torch.cat([numbers, bounds], 1)
        bars = {key: torch.zeros_like(one) for key, one in laid.items()}
        most = max(shear.window for shear in ctx.shears)
        on_rays = field.new_empty(2, len(field) * most)
        for light, (shear, windows) in enumerate(zip(ctx.shears, kept, strict=True)):
            key, bar = shear.is_across_x, shear.turn(entered_bar[light])
            given = {"light": light, "numbers": both, "field": laid[key], "entered_bar": bar}
            given |= {"masses": windows[0], "corrections": windows[1]}
            made = {"slices_bar": on_rays[0], "midways_bar": on_rays[1], "field_bar": bars[key]}
            made["corrections_bar"] = torch.empty_like(bar)
            for name in BACK:
                shear.launch(name, given, made)
        field_bar = functools.reduce(
            torch.add, (bar.transpose(2, 3) if key else bar for key, bar in bars.items())
        )
        # Of numbers, which are few, by the tangents of each.
        both_bar = torch.zeros_like(both)
        _, _, _, *needs = ctx.needs_input_grad
        for one in [*range(3)] * needs[0] + [3] * needs[1]:
            d_both = torch.zeros_like(both)
            d_both[:, one].fill_(1)
            d_entered = _change(ctx.shears, field, both, None, d_both)
            both_bar[:, one] = (d_entered * entered_bar).flatten(1).sum(1, dtype=torch.float64)
        return None, None, field_bar, *both_bar.split([3, 1], 1)

    @staticmethod
    def jvp(ctx: Any, _: None, _has: None, *changes: Tensor | None) -> tuple[Tensor | None, ...]:
        def change(*tensors: Any) -> Tensor:
            (field, *both), (d_field, *d_both) = tensors[:3], tensors[-3:]
            pairs = zip(both, d_both, strict=True)
            d_both = [torch.zeros_like(one) if d_one is None else d_one for one, d_one in pairs]
            return _change(ctx.shears, field, torch.cat(both, 1), d_field, torch.cat(d_both, 1))

        d_entered: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_entered, *[None] * (len(ctx.saved_tensors) - 3)


def _change(
    shears: Sequence[Shear],
    field: Tensor,
    numbers: Tensor,
    d_field: Tensor | None,
    d_numbers: Tensor,
) -> Tensor:
    """The change of the mass with those of the field and of all `numbers` [L, 4]."""
    laid = _lay(shears, _with_change(field, d_field))
    numbers, d_entered = _with_change(numbers, d_numbers), []
    for light, shear in enumerate(shears):
        given: dict[str, Any] = {"light": light, "numbers": numbers}
        given["field"] = laid[shear.is_across_x]
        made = {"masses": field.new_empty(2 * len(field) * shear.window)}
        shear.launch("sum_along_rays_tangent", given, made)
        entered = torch.empty_like(given["field"])
        shear.launch("carry_to_cells_tangent", given | made, {"entered": entered})
        d_entered.append(shear.turn(entered[..., 1]))
    return torch.stack(d_entered)


def _lay(shears: Sequence[Shear], cells: Tensor) -> dict[bool, Tensor]:
    """`cells` as kernels read them, for those of `shears` that are across x and for others."""
    return {key: one.turn(cells) for key, one in {s.is_across_x: s for s in shears}.items()}


def _with_change(value: Tensor, change: Tensor | None) -> Tensor:
    """Dual numbers [..., 2]."""
    return torch.stack([value, torch.zeros_like(value) if change is None else change], -1)


_HEADER = "light/fused/shear.h"
_SLICES = (
    "slices, height, width, rows, columns, first_row, first_column, start, slice_stride, "
    "row_stride, window_slice_stride, window_row_stride, is_slices_first"
)
"""Members of `Slices`, and of a shear's record."""
_GIVEN = f"""
int {_SLICES}, light; F *numbers, *field, *entered, *masses, *corrections;
F *entered_bar, *corrections_bar, *slices_bar, *midways_bar, *field_bar
"""
_RETURNED = "corrections_bar slices_bar midways_bar field_bar"
"""What one adjoint after the other writes, and the next reads."""


@functools.cache
def shear_kernels(bits: int) -> SimpleNamespace:
    """The kernels of `shear.h` for numbers of so many `bits`.

    Tangents are given dual numbers in place of numbers.
    """
    calls = {
        "sum_along_rays": "(const N*)field, (N*)masses, (N*)corrections",
        "carry_to_cells": "(const N*)masses, (N*)entered",
        "carry_back": "masses, entered_bar, corrections_bar",
        "sum_back": "corrections, entered_bar, corrections_bar, slices_bar, midways_bar",
        "look_back": "slices_bar, midways_bar, field_bar",
    }
    made = {"sum_along_rays": "masses corrections", "carry_to_cells": "entered"}

    def kernel(name: str, call: str, number: str, suffix: str = "") -> TextKernel:
        text = f"""
            typedef {number} N;
            const N* const number = (const N*)numbers + 4 * light;
            const Shear<F, IS_GPU ? 1 : {BLOCK}, N> shear({{{_SLICES}}}, number);
            shear.{name}(item, {call});
        """
        writes = made.get(name, _RETURNED)
        return TextKernel(f"shear_{name}{suffix}", bits, text, _GIVEN, writes, _HEADER)

    kernels = {name: kernel(name, call, "F") for name, call in calls.items()}
    for name in made:
        kernels[f"{name}_tangent"] = kernel(name, calls[name], "Dual<F>", "_tangent")
    return SimpleNamespace(**kernels)
