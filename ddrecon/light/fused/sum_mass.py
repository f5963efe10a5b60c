"""What `light.shear.sum_mass_to_cells` returns, as a differentiable function, by fused kernels."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.fused.shear import Shear, change_sum
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly
from ddrecon.numerics.remember import remember
from ddrecon.numerics.slicing import Slicing, across


def sum_mass(
    field: Tensor, grid: Grid, direction: Tensor, bound: Tensor | float
) -> tuple[Tensor, Tensor]:
    """The mass `[K, z, y, x]` up to where a beam enters each cell, and its path in a slice [u]."""
    shears, numbers = follow(grid, direction[None], bound)
    entered: Tensor = _SumMass.apply(shears[0], field, numbers)
    return entered, numbers[0, 2]


@remember
def follow(
    grid: Grid, directions: Tensor, bound: Tensor | float
) -> tuple[tuple[Shear, ...], Tensor]:
    """How beams along `directions` [L, 3] cross slices, and the numbers [L, 4] of each.

    These are the slope by rows and by columns, the path in a slice [u] and the `bound`.
    """
    shears, numbers = _cross(grid, directions)
    bounds = torch.as_tensor(bound).to(numbers).expand(len(numbers), 1)
    return shears, torch.cat([numbers, bounds], 1)


@remember
def _cross(grid: Grid, directions: Tensor) -> tuple[tuple[Shear, ...], Tensor]:
    """The same without bounds: directions are read, whatever the `bound` is made of."""
    speed = directions / directions.new_tensor(grid.spacing)
    slicings = [Slicing.of(each) for each in speed.tolist()]
    order = [[*across(slicing.axis), slicing.axis] for slicing in slicings]
    ordered = speed.gather(1, torch.tensor(order, device=speed.device))
    fastest = ordered[:, 2:].abs()
    slope = ordered[:, :2] / fastest
    slopes = [(row, column) for row, column in slope.tolist()]
    shears = tuple(Shear(grid, *each) for each in zip(slicings, slopes, strict=True))
    return shears, torch.cat([slope, 1 / fastest], 1)


class _SumMass(torch.autograd.Function):
    """The mass entered; differentiable by the field and by the beam's numbers.

    Tangents are by the field and the bound alone.
    """

    @staticmethod
    def forward(shear: Shear, field: Tensor, numbers: Tensor) -> Tensor:
        return shear.lift(shear.sum(shear.lay(field.detach()), numbers, 0).entered)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.shear, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, entered_bar: Tensor) -> tuple[Tensor | None, ...]:
        field, numbers = ctx.saved_tensors
        shear, varies = ctx.shear, ctx.needs_input_grad[2]
        laid = shear.lay(field)
        field_bar = torch.zeros_like(laid)
        found = shear.sum(laid, numbers, 0, True).adjoint(shear.lay(entered_bar), field_bar, varies)
        numbers_bar = None if found is None else found.to(numbers)[None]
        return None, shear.lift(field_bar), numbers_bar

    @staticmethod
    def jvp(ctx: Any, _: None, d_field: Tensor | None, d_numbers: Tensor | None) -> Tensor:
        def change(field: Tensor, numbers: Tensor, *changes: Tensor | None) -> Tensor:
            return change_sum(ctx.shear, 0, field, changes[0], numbers, changes[1])[1]

        d_entered: Tensor = run_plainly(change, *ctx.saved_tensors, d_field, d_numbers)
        return d_entered
