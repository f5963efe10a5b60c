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
from ddrecon.light.fused import shear_code as code
from ddrecon.numerics.slicing import Slicing, across

BLOCK = 256
"""Neighbors in a row that one item does on a processor; on a GPU it is one."""


@wp.struct
class Plan:
    """Slices and rays of one beam: numbers of cells, of rays, and where cell 0 of slice 0 lies."""

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


class Shear:
    """How a beam of `speed` [cells/u] and `slope` (rows, columns) crosses the slices of `grid`.

    Fields are laid out with rows of slices beside each other in memory: `lay` does that, and `lift`
    brings them back.
    """

    def __init__(self, grid: Grid, slicing: Slicing, slope: tuple[float, float]):
        self.axis = slicing.axis
        shape = tuple(grid.shape[a] for a in (slicing.axis, *across(slicing.axis)))
        self.slices, self.height, self.width = shape
        more = [math.floor(abs(s) * (shape[0] - 1) + 1e-9) + 1 for s in slope]
        self.rows, self.columns = self.height + more[0], self.width + more[1]
        plan = Plan()
        plan.slices, plan.height, plan.width = shape
        plan.rows, plan.columns = self.rows, self.columns
        plan.first_row, plan.first_column = (m * (s > 0) for m, s in zip(more, slope, strict=True))
        # Slices across x are laid out one after the other, all others as they lie in the grid.
        slice_stride = grid.shape[2] if self.axis == 1 else self.height * self.width
        plan.row_stride = grid.shape[1] * grid.shape[2] if self.axis == 1 else self.width
        plan.start = (self.slices - 1) * slice_stride if slicing.is_reversed else 0
        plan.slice_stride = -slice_stride if slicing.is_reversed else slice_stride
        self.plan = plan

    def lay(self, cells: Tensor) -> Tensor:
        """`cells` [K, z, y, x] as kernels read them."""
        return (cells.permute(0, 3, 1, 2) if self.axis == 2 else cells).contiguous()

    def lift(self, laid: Tensor) -> Tensor:
        """What `lay` makes of cells, as cells [K, z, y, x]."""
        return laid.permute(0, 2, 3, 1).contiguous() if self.axis == 2 else laid

    def ray_items(self, field: Tensor) -> int:
        """How many items a kernel of rays has."""
        return field.shape[0] * (self.rows + 3) * math.ceil(self.columns / _block(field))

    def cell_items(self, field: Tensor) -> int:
        """How many items a kernel of cells has."""
        return field.shape[0] * self.slices * self.height * math.ceil(self.width / _block(field))

    def new_window(self, field: Tensor) -> Tensor:
        """Uninitialized numbers for the rays that matter on each slice."""
        return field.new_empty(field.shape[0], self.slices, self.height + 3, self.width + 3)


def sum_to_cells(shear: Shear, laid: Tensor, numbers: Tensor, light: int) -> Any:
    """The mass up to where a beam enters each cell, and what `sum_adjoint` needs of it.

    `laid`: a field as `shear` lays it; row `light` of `numbers` [L, 4] holds the beam's slope by
    rows and by columns, its path in a slice [u] and the bound of corrections.
    """
    kernels = shear_kernels(laid.element_size() * 8)
    masses, refinements = shear.new_window(laid), shear.new_window(laid)
    entered = torch.empty_like(laid)
    beam = [shear.plan, line(numbers), light]
    kept = [line(masses), line(refinements)]
    launch(kernels.rays, shear.ray_items(laid), [*beam, line(laid), *kept], laid)
    launch(kernels.cells, shear.cell_items(laid), [*beam, kept[0], line(entered)], laid)
    return entered, (beam, kept, masses, refinements)


def sum_adjoint(
    shear: Shear, laid: Tensor, kept: Any, entered_bar: Tensor, field_bar: Tensor, varies: bool
) -> Tensor | None:
    """The cotangent [4] of the beam's row of numbers, if it `varies`; adds to that of the field.

    `kept`: from `sum_to_cells`, usable once. All cotangents are laid out as the field is.
    """
    kernels = shear_kernels(laid.element_size() * 8)
    beam, windows, *_ = kept
    bars, parts = line(entered_bar), line(torch.empty_like(laid))
    cells, rays = shear.cell_items(laid), shear.ray_items(laid)
    sums = [
        laid.new_zeros(4 * count if varies else 0, dtype=torch.float64)
        for count in (cells, rays, cells)
    ]
    by_cells, by_rays, by_field = map(line, sums)
    launch(kernels.cells_adjoint, cells, [*beam, windows[0], bars, parts, varies, by_cells], laid)
    launch(kernels.rays_adjoint, rays, [*beam, *windows, bars, parts, varies, by_rays], laid)
    fields = [line(laid), line(field_bar)]
    launch(kernels.field_adjoint, cells, [*beam, *windows, *fields, varies, by_field], laid)
    return sum(part.view(-1, 4).sum(0) for part in sums) if varies else None


def line(tensor: Tensor) -> Any:
    """`tensor` as Warp's array of one dimension."""
    return array(tensor.reshape(-1))


def _block(like: Tensor) -> int:
    return 1 if like.is_cuda else BLOCK


@functools.cache
def shear_kernels(bits: int) -> SimpleNamespace:
    """The kernels for numbers of so many `bits`."""
    F = number_type(bits)
    Numbers, Sums = wp.array(dtype=F), wp.array(dtype=wp.float64)

    @wp.func_native(program(bits, code.RAYS))
    def sum_rays(
        item: int,
        plan: Plan,
        numbers: Numbers,
        light: int,
        field: Numbers,
        masses: Numbers,
        refinements: Numbers,
    ): ...

    @wp.func_native(program(bits, code.CELLS))
    def gather_cells(
        item: int, plan: Plan, numbers: Numbers, light: int, masses: Numbers, entered: Numbers
    ): ...

    @wp.func_native(program(bits, code.CELLS_ADJOINT))
    def gather_cells_adjoint(
        item: int,
        plan: Plan,
        numbers: Numbers,
        light: int,
        masses: Numbers,
        entered_bar: Numbers,
        corrections_bar: Numbers,
        varies: bool,
        sums: Sums,
    ): ...

    @wp.func_native(program(bits, code.RAYS_ADJOINT))
    def sum_rays_adjoint(
        item: int,
        plan: Plan,
        numbers: Numbers,
        light: int,
        masses: Numbers,
        refinements: Numbers,
        entered_bar: Numbers,
        corrections_bar: Numbers,
        varies: bool,
        sums: Sums,
    ): ...

    @wp.func_native(program(bits, code.FIELD_ADJOINT))
    def gather_field_adjoint(
        item: int,
        plan: Plan,
        numbers: Numbers,
        light: int,
        masses: Numbers,
        refinements: Numbers,
        field: Numbers,
        field_bar: Numbers,
        varies: bool,
        sums: Sums,
    ): ...

    options = {"enable_backward": False, "module": "unique"}

    @wp.kernel(**options)
    def rays(
        first: int,
        plan: Plan,
        numbers: Numbers,
        light: int,
        field: Numbers,
        masses: Numbers,
        refinements: Numbers,
    ):
        sum_rays(first + wp.tid(), plan, numbers, light, field, masses, refinements)

    @wp.kernel(**options)
    def cells(
        first: int, plan: Plan, numbers: Numbers, light: int, masses: Numbers, entered: Numbers
    ):
        gather_cells(first + wp.tid(), plan, numbers, light, masses, entered)

    @wp.kernel(**options)
    def cells_adjoint(
        first: int,
        plan: Plan,
        numbers: Numbers,
        light: int,
        masses: Numbers,
        entered_bar: Numbers,
        corrections_bar: Numbers,
        varies: bool,
        sums: Sums,
    ):
        item = first + wp.tid()
        gather_cells_adjoint(
            item, plan, numbers, light, masses, entered_bar, corrections_bar, varies, sums
        )

    @wp.kernel(**options)
    def rays_adjoint(
        first: int,
        plan: Plan,
        numbers: Numbers,
        light: int,
        masses: Numbers,
        refinements: Numbers,
        entered_bar: Numbers,
        corrections_bar: Numbers,
        varies: bool,
        sums: Sums,
    ):
        item = first + wp.tid()
        sum_rays_adjoint(
            item,
            plan,
            numbers,
            light,
            masses,
            refinements,
            entered_bar,
            corrections_bar,
            varies,
            sums,
        )

    @wp.kernel(**options)
    def field_adjoint(
        first: int,
        plan: Plan,
        numbers: Numbers,
        light: int,
        masses: Numbers,
        refinements: Numbers,
        field: Numbers,
        field_bar: Numbers,
        varies: bool,
        sums: Sums,
    ):
        item = first + wp.tid()
        gather_field_adjoint(
            item, plan, numbers, light, masses, refinements, field, field_bar, varies, sums
        )

    return SimpleNamespace(
        rays=rays,
        cells=cells,
        cells_adjoint=cells_adjoint,
        rays_adjoint=rays_adjoint,
        field_adjoint=field_adjoint,
    )
