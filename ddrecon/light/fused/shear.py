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
from ddrecon.light.fused import shear_adjoint_code as adjoint_code
from ddrecon.light.fused import shear_code as code
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
    `has_adjoint` what that needs is kept. `before` [2, K, rows, columns]: sums along rays of what
    lies before the first slice, of the field and of its bends; `before_bar` their cotangent.
    """

    def __init__(
        self,
        shear: Shear,
        laid: Tensor,
        numbers: Tensor,
        light: int,
        has_adjoint: bool = False,
        before: Tensor | None = None,
    ):
        self.shear, self.laid = shear, laid
        self.kernels = shear_kernels(laid.element_size() * 8)
        self.entered = torch.empty_like(laid)
        windows = laid.new_empty(1 + has_adjoint, len(laid) * shear.window)
        self.masses, self.refinements = windows[0], windows[-1]
        self.given = shear.record | {"light": light, "numbers": numbers, "field": laid}
        self.given |= {"channels": len(laid), "before": before}
        self.before = before
        self.before_bar: Tensor | None = None
        rays, cells = shear.items(laid)
        made = {"masses": self.masses, "refinements": self.refinements if has_adjoint else None}
        self.kernels.rays.launch(rays, self.given, made)
        self.kernels.cells.launch(cells, self.given | made, {"entered": self.entered})

    def adjoint(self, entered_bar: Tensor, field_bar: Tensor, varies: bool) -> Tensor | None:
        """The cotangent [4] of the beam's numbers, if it `varies`; adds to that of the field.

        To be called once. All cotangents are laid out as the field is.
        """
        rays, cells = self.shear.items(self.laid)
        counts = {"by_cells": cells, "by_rays": rays, "by_field": cells}
        sums = {
            name: self.laid.new_zeros(4 * count * varies, dtype=torch.float64)
            for name, count in counts.items()
        }
        given = self.given | {"varies": varies, "entered_bar": entered_bar}
        made = sums | {"masses": self.masses, "refinements": self.refinements}
        if self.before is not None:
            made["before_bar"] = self.before_bar = torch.zeros_like(self.before)
        made |= {"corrections_bar": torch.empty_like(entered_bar), "field_bar": field_bar}
        self.kernels.cells_adjoint.launch(cells, given, made)
        self.kernels.rays_adjoint.launch(rays, given, made)
        self.kernels.field_adjoint.launch(cells, given, made)
        if not varies:
            return None
        return torch.stack([each.view(-1, 4).sum(0) for each in sums.values()]).sum(0)


_GIVEN = """
int slices, height, width, rows, columns, first_row, first_column, start, slice_stride, row_stride;
int window_slice_stride, window_row_stride, is_slices_first, light, varies, first_slice, channels;
F *numbers, *field, *entered, *masses, *refinements, *entered_bar, *corrections_bar, *field_bar;
F *before, *after, *before_bar, *after_bar;
double *by_cells, *by_rays, *by_field
"""
_RETURNED = "masses refinements corrections_bar field_bar before_bar by_cells by_rays by_field"
"""What one adjoint after the other writes, and the next reads."""


@functools.cache
def shear_kernels(bits: int) -> SimpleNamespace:
    """The kernels for numbers of so many `bits`."""
    texts = {
        "rays": (code.RAYS, "masses refinements after"),
        "cells": (code.CELLS, "entered"),
        "cells_adjoint": (adjoint_code.CELLS_ADJOINT, _RETURNED),
        "rays_adjoint": (adjoint_code.RAYS_ADJOINT, _RETURNED),
        "field_adjoint": (adjoint_code.FIELD_ADJOINT, _RETURNED),
    }
    kernels = {
        name: TextKernel(f"shear_{name}", bits, text, _GIVEN, made)
        for name, (text, made) in texts.items()
    }
    return SimpleNamespace(**kernels)
