"""The mass that a beam passes on its way to each cell, by fused kernels, and its adjoint.

Rays gather the field of all slices, one row of rays at a time; cells gather from rays. The same in
the other order for the adjoint: in no step do two items write to the same place.
"""

import functools
import math
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.launch import array, launch
from ddrecon.kernels.native import number_type, program
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
            "window_slice": window[0] if is_slices_first else window[1],
            "window_row": window[1] if is_slices_first else window[0],
            "is_slices_first": is_slices_first,
        }
        self.window = count * (height + 3) * (width + 3)

    def lay(self, cells: Tensor) -> Tensor:
        """`cells` [K, z, y, x] as kernels read them."""
        return (cells.transpose(2, 3) if self.axis == 2 else cells).contiguous()

    def lift(self, laid: Tensor) -> Tensor:
        """What `lay` makes of cells, as cells [K, z, y, x]."""
        return laid.transpose(2, 3).contiguous() if self.axis == 2 else laid

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
        self.kernels = shear_kernels(laid.element_size() * 8)
        self.entered = torch.empty_like(laid)
        self.windows = laid.new_empty(1 + has_adjoint, len(laid) * shear.window)
        self.beam = self.kernels.Beam()
        for name, number in shear.record.items():
            setattr(self.beam, name, number)
        self.beam.light, self.beam.has_refinements = light, has_adjoint
        self._give(numbers=numbers, field=laid, entered=self.entered)
        self._give(masses=self.windows[0], refinements=self.windows[-1])
        rays, cells = shear.items(laid)
        launch(self.kernels.rays, rays, [self.beam], laid)
        launch(self.kernels.cells, cells, [self.beam], laid)

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
        corrections_bar = torch.empty_like(entered_bar)
        self.beam.varies = varies
        self._give(entered_bar=entered_bar, corrections_bar=corrections_bar, field_bar=field_bar)
        self._give(**sums)
        launch(self.kernels.cells_adjoint, cells, [self.beam], self.laid)
        launch(self.kernels.rays_adjoint, rays, [self.beam], self.laid)
        launch(self.kernels.field_adjoint, cells, [self.beam], self.laid)
        if not varies:
            return None
        return torch.stack([each.view(-1, 4).sum(0) for each in sums.values()]).sum(0)

    def _give(self, **tensors: Tensor) -> None:
        for name, tensor in tensors.items():
            setattr(self.beam, name, array(tensor.reshape(-1)))


@functools.cache
def shear_kernels(bits: int) -> SimpleNamespace:
    """The kernels for numbers of so many `bits`, and the record `Beam` that they are given."""
    F = number_type(bits)

    @wp.struct
    class Beam:
        """Slices and rays of one beam, and the arrays of `Sum`."""

        slices: int
        height: int
        width: int
        rows: int
        columns: int
        first_row: int
        first_column: int
        start: int
        slice_stride: int
        row_stride: int
        window_slice: int
        window_row: int
        is_slices_first: bool
        has_refinements: bool
        light: int
        varies: bool
        numbers: wp.array(dtype=F)
        field: wp.array(dtype=F)
        entered: wp.array(dtype=F)
        masses: wp.array(dtype=F)
        refinements: wp.array(dtype=F)
        entered_bar: wp.array(dtype=F)
        corrections_bar: wp.array(dtype=F)
        field_bar: wp.array(dtype=F)
        by_cells: wp.array(dtype=wp.float64)
        by_rays: wp.array(dtype=wp.float64)
        by_field: wp.array(dtype=wp.float64)

    def kernel(body: str) -> Any:
        @wp.func_native(program(bits, body))
        def do_item(item: int, beam: Beam): ...

        @wp.kernel(enable_backward=False, module="unique")
        def do_items(first: int, beam: Beam):
            do_item(first + wp.tid(), beam)

        return do_items

    return SimpleNamespace(
        Beam=Beam,
        rays=kernel(code.RAYS),
        cells=kernel(code.CELLS),
        cells_adjoint=kernel(adjoint_code.CELLS_ADJOINT),
        rays_adjoint=kernel(adjoint_code.RAYS_ADJOINT),
        field_adjoint=kernel(adjoint_code.FIELD_ADJOINT),
    )
