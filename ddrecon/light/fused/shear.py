"""The mass of beams on their way to cells, by the kernels of `shear.h`, and its derivatives.

Rays gather the field of all slices, one row of rays at a time; cells gather from rays. The adjoint
gathers in the other order: in no step do two items write to the same place.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from ddrecon.kernels.launch import launch_later
from ddrecon.kernels.text import TextKernel
from ddrecon.light.shear import Shear
from ddrecon.numerics.autodiff import differentiate_once, fill_changes, keep, run_plainly
from ddrecon.numerics.layout import Slicing

GHOSTS = 3
"""Cells beyond the outermost ones that rays look at."""
BLOCK = 256
"""Neighbors in a row that one item does on a processor; on a GPU it is one."""


def sum_masses(field: Tensor, shears: Sequence[Shear], bound: Tensor) -> Tensor:
    """The mass [L, K, z, y, x] of `field` [K, z, y, x] up to where L beams enter each cell.

    As of `light.shear.sum_masses`; differentiated in forward mode by `field` and `bound` alone.
    """
    fields = [slicing.lay(field) for slicing in _slicings(shears)]
    numbers = torch.stack([shear.numbers for shear in shears])
    columns = [*range(3)] * numbers.requires_grad + [3] * bound.requires_grad
    has_adjoint = torch.is_grad_enabled() and (field.requires_grad or bool(columns))
    numbers = torch.cat([numbers, bound.expand(len(shears), 1)], 1)
    entered, *_ = _Masses.apply(shears, columns if has_adjoint else None, numbers, *fields)
    return entered


def _slicings(shears: Sequence[Shear]) -> list[Slicing]:
    return [*dict.fromkeys(shear.slicing for shear in shears)]


class _Masses(torch.autograd.Function):
    """The mass, and the slopes of each beam's corrections.

    Row l of `numbers` [L, 4] is the slope of beam l by rows and by columns, its path in a slice
    [u], and the bound of corrections; those `columns` vary; without an adjoint they are None, and
    there are no slopes. There are `fields` [N, K, rows, columns] for each slicing of `shears`.
    """

    @staticmethod
    def forward(
        shears: Sequence[Shear], columns: list[int] | None, numbers: Tensor, *fields: Tensor
    ) -> tuple[Tensor, ...]:
        laid = dict(zip(_slicings(shears), map(_widen, fields), strict=True))
        slopes = list[Tensor]()
        for name in () if columns is None else ("sum_back", "look_back"):
            launch_later(shear_kernel(name, 8 * numbers.itemsize).kernel, numbers)
        entered = numbers.new_empty(len(shears), fields[0].shape[1], *shears[0].grid.shape)
        for light, shear in enumerate(shears):
            mass, *mass_slopes = _sum(shear, laid[shear.slicing], numbers[light])
            entered[light] = shear.slicing.lift(mass)
            slopes += [] if columns is None else mass_slopes
        return entered, *slopes

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.shears, ctx.columns, *tensors = inputs
        ctx.mark_non_differentiable(*output[1:])
        ctx.set_materialize_grads(False)
        keep(ctx, *tensors, *output[1:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, entered_bar: Tensor, *_: Tensor) -> tuple[Any, ...]:
        numbers, *tensors = ctx.saved_tensors
        laid = dict(zip(_slicings(ctx.shears), tensors, strict=False))
        slopes = iter(tensors[len(laid) :])
        bars = {slicing: field.new_zeros(field.shape) for slicing, field in laid.items()}
        # No column varies of beams that stay.
        numbers_bar = torch.zeros_like(numbers) if ctx.columns else numbers
        for light, shear in enumerate(ctx.shears):
            mass_bar = shear.slicing.lay(entered_bar[light]).contiguous()
            row, field, ray_slopes = numbers[light], laid[shear.slicing], next(slopes)
            of_rays = {name: torch.empty_like(ray_slopes) for name in ("slices_bar", "midways_bar")}
            of_cells = {"entered_bar": mass_bar, "corrections_bar": next(slopes) * mass_bar}
            arguments = {"numbers": row, "slopes": ray_slopes} | of_cells
            _launch("sum_back", shear, arguments, of_rays)
            field_bar = {"field_bar": bars[shear.slicing]}
            _launch("look_back", shear, {"numbers": row} | of_rays, field_bar)
            # Of numbers, which are few, by the tangents of each.
            for column in ctx.columns:
                d_row = torch.zeros_like(row)
                d_row[column].fill_(1)
                d_mass = _sum_tangent(shear, field, row, torch.zeros_like(field), d_row)
                numbers_bar[light, column] = (d_mass * mass_bar).sum(dtype=torch.float64)
        return None, None, numbers_bar if ctx.columns else None, *bars.values()

    @staticmethod
    def jvp(ctx: Any, _: None, _has: None, *changes: Tensor | None) -> tuple[Tensor | None, ...]:
        def change(*tensors: Any) -> Tensor:
            (numbers, *fields), changes = tensors[:count], tensors[-count:]
            d_numbers, *d_fields = fill_changes(changes, tensors[:count])
            slicings = _slicings(ctx.shears)
            laid = {k: pair for k, *pair in zip(slicings, fields, d_fields, strict=True)}
            tangents = []
            for shear, row, d_row in zip(ctx.shears, numbers, d_numbers, strict=True):
                field, d_field = laid[shear.slicing]
                d_mass = _sum_tangent(shear, field, row, d_field, d_row)
                tangents.append(shear.slicing.lift(d_mass))
            return torch.stack(tangents)

        count = len(changes)
        d_entered: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_entered, *[None] * (len(ctx.saved_tensors) - count)


def _widen(field: Tensor) -> Tensor:
    """`field` [N, K, rows, columns] with ghosts around each slice, as the outermost cells."""
    return pad(field, [GHOSTS] * 4, mode="replicate")


def _sum(shear: Shear, field: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The mass, and the slopes of its corrections on rays and at cells.

    `field` and `numbers` [4] have a last dimension of 2 where they, and the mass, are dual numbers.
    """
    (slices, channels), (height, width) = field.shape[:2], shear.size
    masses = field.new_empty(slices, channels, height + 3, width + 3, *field.shape[4:])
    entered = field.new_empty(slices, channels, height, width, *field.shape[4:])
    ray_slopes, slopes = (field.new_empty(mass.shape[:4]) for mass in (masses, entered))
    arguments = {"numbers": numbers, "field": field}
    _launch("sum_along_rays", shear, arguments, {"masses": masses, "slopes": ray_slopes})
    arguments = {"numbers": numbers, "masses": masses}
    _launch("carry_to_cells", shear, arguments, {"entered": entered, "slopes": slopes})
    return entered, ray_slopes, slopes


def _sum_tangent(
    shear: Shear, field: Tensor, numbers: Tensor, d_field: Tensor, d_numbers: Tensor
) -> Tensor:
    """The change of the mass with those of the `field`, without ghosts, and of `numbers` [4]."""
    fields = _widen(field), _widen(d_field)
    duals = (torch.stack(pair, -1) for pair in (fields, (numbers, d_numbers)))
    return _sum(shear, *duals)[0][..., 1].contiguous()


_SIZES = "slices, channels, height, width, rows, columns, first_row, first_column"
"""Members of `Slices`."""
_KERNELS = {
    "sum_along_rays": ("(const N*)field, (N*)masses, slopes", "masses slopes"),
    "carry_to_cells": ("(const N*)masses, (N*)entered, slopes", "entered slopes"),
    "sum_back": (
        "slopes, entered_bar, corrections_bar, slices_bar, midways_bar",
        "slices_bar midways_bar",
    ),
    "look_back": ("slices_bar, midways_bar, field_bar", "field_bar"),
}
"""What each kernel is called with, and what of that it writes."""


def _launch(
    name: str, shear: Shear, arguments: dict[str, Tensor], outputs: dict[str, Tensor]
) -> None:
    """Runs a kernel for all rays, or all cells of its first output."""
    first = next(iter(outputs.values()))
    slices, channels, rows, columns = first.shape[:4]
    lines, length = shear.lattice if name.startswith("sum") else (slices * rows, columns)
    items = channels * lines * math.ceil(length / (1 if first.is_cuda else BLOCK))
    sizes = slices, channels, *shear.size, *shear.lattice, *shear.first
    record = dict(zip(_SIZES.split(", "), sizes, strict=True))
    kernel = shear_kernel(name, 8 * first.itemsize, is_dual=first.ndim > 4)
    kernel.launch(items, record | arguments, outputs)


@functools.cache
def shear_kernel(name: str, bits: int, is_dual: bool = False) -> TextKernel:
    """The kernel `name` of `shear.h`, for numbers of so many `bits` or dual ones."""
    call, written = _KERNELS[name]
    text = f"""
        typedef {"Dual<F>" if is_dual else "F"} N;
        const N* const n = (const N*)numbers;
        const Shear<F, IS_GPU ? 1 : {BLOCK}, N> shear{{{{{_SIZES}}}, n[0], n[1], n[2], n[3]}};
        shear.{name}(item, {call});
    """
    arrays = call.replace("(const N*)", "").replace("(N*)", "").split(", ")
    declared = f"int {_SIZES}; F *numbers, *{', *'.join(arrays)}"
    name = f"shear_{name}{'_tangent' * is_dual}"
    return TextKernel(name, bits, text, declared, written, "light/fused/shear.h")
