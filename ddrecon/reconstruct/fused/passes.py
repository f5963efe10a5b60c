"""Adam's step and total variation as functions of tensors, by the kernels of `passes.h`."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.text import BLOCK, TextKernel, cut
from ddrecon.losses import ROUNDING
from ddrecon.numerics.autodiff import differentiate_once
from ddrecon.reconstruct import tuning

LENGTH = 4096
"""Numbers that an item of a launch steps on a processor."""
PART = 32
"""Cells of a row that a thread does on a GPU."""


def step_adam(
    value: Tensor,
    gradient: Tensor,
    moments: tuple[Tensor, Tensor],
    steps: int,
    rate: float,
    smallest: Tensor,
    bounds: tuple[float, float],
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """The new value, within its bounds, and the new moments, after `steps` with this one.

    `smallest`, a number or one for each, is added to the size of derivatives. The value moves along
    a mixture of the mean derivative and the newest (E10.1).
    """
    new = [value.new_empty(value.shape) for _ in range(3)]
    betas = tuning.BETAS
    weights = [1 - beta**steps for beta in betas]
    items, length = cut(value.numel(), LENGTH, value)
    given = {
        "length": length,
        "total": value.numel(),
        "value": value,
        "gradient": gradient,
        "first": moments[0],
        "second": moments[1],
        "forget_first": 1 - betas[0],
        "forget_second": 1 - betas[1],
        "scale": weights[1] ** -0.5,
        "ahead": betas[0],
        "smallest": smallest,
        "rate": rate / weights[0],
        "low": bounds[0],
        "high": bounds[1],
    }
    made = dict(zip(("new_value", "new_first", "new_second"), new, strict=True))
    kernel = step_kernel(8 * value.element_size(), smallest.numel() > 1)
    kernel.launch(items, given, made)
    return new[0], (new[1], new[2])


def total_variation(field: Tensor, grid: Grid) -> Tensor:
    """What `losses.total_variation` is of `field` [..., z, y, x], differentiable once."""
    total: Tensor
    total, _ = _Variation.apply(field, grid)
    return total


def variation_diagonal(field: Tensor, grid: Grid) -> Tensor:
    """The diagonal of R (E11.2) about `field` [..., z, y, x] where smoothing weighs 1."""
    return _vary(field, grid)[2].div_(field.numel())


def _vary(field: Tensor, grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
    """`totals`, `slope` and `diagonal` of `field` [..., z, y, x], as of `passes.h`."""
    side, (nz, ny, nx) = min(grid.extent), field.shape[-3:]
    slope, diagonal = field.new_empty(field.shape), field.new_empty(field.shape)
    length = PART if field.is_cuda else nx
    items = field.numel() // nx * -(-nx // length)
    totals = field.new_empty(items, dtype=torch.float64)
    kz, ky, kx = (side / spacing for spacing in grid.spacing)
    given = {"length": length, "nz": nz, "ny": ny, "nx": nx, "field": field}
    given |= {"kz": kz, "ky": ky, "kx": kx, "rounding": ROUNDING}
    made = {"slope": slope, "diagonal": diagonal, "totals": totals}
    variation_kernel(8 * field.element_size()).launch(items, given, made)
    return totals, slope, diagonal


class _Variation(torch.autograd.Function):
    """Total variation and its derivative, found together: a penalty needs both."""

    @staticmethod
    def forward(field: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
        totals, slope, _ = _vary(field, grid)
        return (totals.sum() / field.numel()).to(field.dtype), slope

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, total_bar: Tensor, _: None) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return (total_bar / slope.numel()) * slope, None


_HEADER = "reconstruct/fused/passes.h"
_STEP = "forget_first, forget_second, scale, ahead, rate, low, high"


@functools.cache
def step_kernel(bits: int, is_each: bool) -> TextKernel:
    """The kernel of a step of Adam; `smallest` is one number, or `is_each` one for each."""
    given, made = "value, gradient, first, second", "new_value, new_first, new_second"
    text = f"Step<F>{{{_STEP}}}.take<{int(is_each)}>(begin, end, smallest, {given}, {made});"
    arrays = ", ".join(f"*{name}" for name in f"smallest, {given}, {made}".split(", "))
    declared = f"int length, total; F {_STEP}, {arrays}"
    return TextKernel("step", bits, BLOCK + text, declared, made.replace(",", ""), _HEADER)


@functools.cache
def variation_kernel(bits: int) -> TextKernel:
    """The kernel of lengths of the gradient, with slope and diagonal (E11.2) of their sum."""
    text = """
        const Variation<F> variation{nz, ny, nx, kz, ky, kx, rounding};
        totals[item] = variation.vary(item, length, field, slope, diagonal);
    """
    numbers = "int length, nz, ny, nx; F kz, ky, kx, rounding"
    given = f"{numbers}, *field, *slope, *diagonal; double *totals"
    return TextKernel("vary", bits, text, given, "slope diagonal totals", _HEADER)
