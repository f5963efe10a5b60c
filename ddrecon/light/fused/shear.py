"""The mass that a beam passes on its way to each cell, by fused kernels, and its adjoint.

Rays gather the field of all slices, one row of rays at a time; cells gather from rays. The same in
the other order for the adjoint: in no step do two items write to the same place.
"""

from __future__ import annotations

import functools
import math
from types import SimpleNamespace

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.text import TextKernel
from ddrecon.numerics.slicing import Slicing, across

BLOCK = 256
"""Neighbors in a row that one item does on a processor; on a GPU it is one."""


class Shear:
    """How a beam of some `slope` (by rows, by columns) crosses the slices of `grid`.

    Kernels want the columns of slices beside each other in memory: `lay` sees to that, and `lift`
    brings cells back.
    """

    def __init__(self, grid: Grid, slicing: Slicing, slope: tuple[float, float]):
        self.axis = slicing.axis
        count, height, width = (grid.shape[a] for a in (self.axis, *across(self.axis)))
        more = [math.floor(abs(s) * (count - 1) + 1e-9) + 1 for s in slope]
        # A row of one slice is followed by the same row of the next, but for slices across z.
        is_slices_first = self.axis != 0
        slice_stride, row_stride = (
            (width, count * width) if is_slices_first else (height * width, width)
        )
        window = (width + 3, (width + 3) * (count if is_slices_first else height + 3))
        self.record = {
            "slices": count,
            "height": height,
            "width": width,
            "rows": height + more[0],
            "columns": width + more[1],
            "first_row": more[0] * (slope[0] > 0),
            "first_column": more[1] * (slope[1] > 0),
            "start": (count - 1) * slice_stride * slicing.is_reversed,
            "slice_stride": -slice_stride if slicing.is_reversed else slice_stride,
            "row_stride": row_stride,
            "window_slice_stride": window[0] if is_slices_first else window[1],
            "window_row_stride": window[1] if is_slices_first else window[0],
            "is_slices_first": is_slices_first,
        }
        self.window = count * (height + 3) * (width + 3)

    def lay(self, cells: Tensor) -> Tensor:
        """`cells` [K, z, y, x] as kernels read them."""
        return (cells.transpose(2, 3) if self.axis == 2 else cells).contiguous()

    def lift(self, laid: Tensor) -> Tensor:
        """What `lay` makes of cells, as cells [K, z, y, x]."""
        return laid.transpose(2, 3).contiguous() if self.axis == 2 else laid

    def sum(self, laid: Tensor, numbers: Tensor, light: int, has_adjoint: bool = False) -> Sum:
        """The mass of `laid`."""
        return Sum(self, laid, numbers, light, has_adjoint)

    def items(self, field: Tensor) -> tuple[int, int]:
        """How many items kernels of rays have, and those of cells."""
        block, record = 1 if field.is_cuda else BLOCK, self.record
        rays = (record["rows"] + 3) * math.ceil(record["columns"] / block)
        cells = record["slices"] * record["height"] * math.ceil(record["width"] / block)
        return len(field) * rays, len(field) * cells


class Sum:
    """The mass of `laid`, a field as `shear` lays it, up to where a beam enters each cell.

    Row `light` of `numbers` [L, 4] holds the beam's slope by rows and by columns, its path in a
    slice [u] and the bound of corrections. `entered` is laid out as the field is. Only where it
    `has_adjoint` what that needs is kept.
    """

    def __init__(
        self, shear: Shear, laid: Tensor, numbers: Tensor, light: int, has_adjoint: bool = False
    ):
        self.shear, self.laid = shear, laid
        self.entered = torch.empty_like(laid)
        windows = laid.new_empty(1 + has_adjoint, len(laid) * shear.window)
        self.masses, self.corrections = windows[0], windows[-1]
        self.given = shear.record | {"light": light, "numbers": numbers, "field": laid}
        made = {"masses": self.masses, "corrections": self.corrections if has_adjoint else None}
        kernels = shear_kernels(laid.element_size() * 8)
        rays, cells = shear.items(laid)
        kernels.sum_along_rays.launch(rays, self.given, made)
        kernels.carry_to_cells.launch(cells, self.given | made, {"entered": self.entered})

    def adjoint(self, entered_bar: Tensor, field_bar: Tensor, varies: bool) -> Tensor | None:
        """The cotangent [4] of the beam's numbers, if it `varies`; adds to that of the field.

        To be called once. All cotangents are laid out as the field is.
        """
        kernels, (rays, cells) = (
            shear_kernels(self.laid.element_size() * 8),
            self.shear.items(self.laid),
        )
        steps = (kernels.carry_back, cells), (kernels.sum_back, rays), (kernels.look_back, cells)
        given = self.given | {"varies": varies, "entered_bar": entered_bar}
        made = {"masses": self.masses, "corrections": self.corrections, "field_bar": field_bar}
        made["corrections_bar"] = torch.empty_like(entered_bar)
        found = self.laid.new_zeros(4, dtype=torch.float64)
        for kernel, items in steps:
            sums = found.new_zeros(items * varies, 4)
            kernel.launch(items, given, made | {"sums": sums})
            found += sums.sum(0)
        return found if varies else None


def change_sum(
    shear: Shear,
    light: int,
    field: Tensor,
    d_field: Tensor | None,
    numbers: Tensor,
    d_numbers: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """The mass up to where beam number `light` enters cells [K, z, y, x], and its change.

    Of `d_numbers` that of the bound counts.
    """
    laid = _with_change(shear.lay(field), None if d_field is None else shear.lay(d_field))
    kernels, (rays, cells) = shear_kernels(laid.element_size() * 8), shear.items(field)
    numbers = _with_change(numbers, d_numbers)
    given = shear.record | {"light": light, "numbers": numbers, "field": laid}
    masses, entered = laid.new_empty(2 * len(laid) * shear.window), torch.empty_like(laid)
    kernels.sum_along_rays_tangent.launch(rays, given, {"masses": masses})
    kernels.carry_to_cells_tangent.launch(cells, given | {"masses": masses}, {"entered": entered})
    value, change = (shear.lift(each.contiguous()) for each in entered.unbind(-1))
    return value, change


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
int {_SLICES}, light, varies; F *numbers, *field, *entered, *masses, *corrections;
F *entered_bar, *corrections_bar, *field_bar; double *sums
"""
_RETURNED = "masses corrections corrections_bar field_bar sums"
"""What one adjoint after the other writes, and the next reads."""


@functools.cache
def shear_kernels(bits: int) -> SimpleNamespace:
    """The kernels of `shear.h` for numbers of so many `bits`.

    Tangents are given dual numbers in place of numbers.
    """
    calls = {
        "sum_along_rays": "number[3], (const N*)field, (N*)masses, (N*)corrections",
        "carry_to_cells": "number[3], (const N*)masses, (N*)entered",
        "carry_back": "varies, masses, entered_bar, corrections_bar, sums",
        "sum_back": "varies, entered_bar, corrections_bar, masses, corrections, sums",
        "look_back": "varies, field, masses, corrections, field_bar, sums",
    }
    made = {"sum_along_rays": "masses corrections", "carry_to_cells": "entered"}

    def kernel(name: str, call: str, number: str, suffix: str = "") -> TextKernel:
        text = f"""
            typedef {number} N;
            const N* const number = (const N*)numbers + 4 * light;
            const Shear<F, IS_GPU ? 1 : {BLOCK}> shear({{{_SLICES}}}, number);
            shear.{name}(item, {call});
        """
        writes = made.get(name, _RETURNED)
        return TextKernel(f"shear_{name}{suffix}", bits, text, _GIVEN, writes, _HEADER)

    kernels = {name: kernel(name, call, "F") for name, call in calls.items()}
    for name in made:
        kernels[f"{name}_tangent"] = kernel(name, calls[name], "Dual<F>", "_tangent")
    return SimpleNamespace(**kernels)
