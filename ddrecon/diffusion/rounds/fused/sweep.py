"""A sweep as one differentiable function of tensors, by fused kernels (E11, E12)."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.part import Part, Plan, Swept, Weighted
from ddrecon.diffusion.rounds.fused.schedule import schedules
from ddrecon.diffusion.rounds.fused.turning import add_turned
from ddrecon.kernels.spare import give_back
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once


def sweep_fused(
    medium: Medium,
    light: Moments,
    inflow: Tensor | None,
    weighted: Weighted,
    by_cells: bool | None = None,
) -> tuple[Tensor, ...]:
    """The moments of E12 of radiance along `weighted` directions, as `sweep` returns them.

    `by_cells`: whether a thread does a cell of a slice, not directions; None: on a GPU.
    """
    colors = light.mean.shape[0]
    strength = (1 - medium.forward_fraction) * medium.scattering.scale
    entering = light.mean.new_zeros(1) if inflow is None else inflow
    numbers = torch.stack(
        [each.reshape(-1).expand(colors) for each in (medium.extinction.scale, strength, entering)]
    )
    shares_field = medium.scattering.field is medium.extinction.field
    moments: tuple[Tensor, ...] = _Sweep.apply(
        Plan(medium.grid, weighted, light.mean.is_cuda if by_cells is None else by_cells),
        numbers,
        medium.extinction.field,
        None if shares_field else medium.scattering.field,
        light.mean,
        *(light.flux or ()),
    )
    return moments


class _Sweep(torch.autograd.Function):
    """The moments of light, and their derivatives by `numbers` [3, C], fields and light."""

    @staticmethod
    def forward(ctx: Any, plan: Plan, *tensors: Any) -> tuple[Tensor, ...]:
        ctx.plan = plan
        ctx.save_for_backward(*tensors)
        parts = _parts(plan, Swept.of(*tensors))
        shares, turned = (part.follow() for part in parts)
        moments = _add_up(shares, turned)
        give_back(*shares[1:], *turned)
        return moments.unbind(0)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Any, ...]:
        varies_numbers = ctx.needs_input_grad[1]
        parts = _parts(ctx.plan, Swept.of(*ctx.saved_tensors))
        (one, *cells), (other, *turned) = (part.transpose(bars, varies_numbers) for part in parts)
        light_bars = _add_up(cells[0], turned[0])
        give_back(*cells[0][1:], *turned[0])
        field_bars = [_add_up(*each) for each in zip(cells[1:], turned[1:], strict=True)]
        numbers_bar = None
        if varies_numbers:
            sums = (part.double().sum((2, 3)) for part in (*one, *other))
            numbers_bar = functools.reduce(Tensor.add, sums).to(light_bars)
        # A field of one channel for all colors, or none where extinction's serves scattering too.
        of_fields = [
            None if field is None or bar is None else bar.sum_to_size(field.shape)
            for bar, field in zip((*field_bars, None), ctx.saved_tensors[1:3], strict=False)
        ]
        return None, numbers_bar, *of_fields, *light_bars.unbind(0)


def _add_up(shares: list[Tensor], turned: list[Tensor]) -> Tensor:
    """The sum of threads' `shares` of both parts, in the memory of the first."""
    return add_turned(*(functools.reduce(Tensor.add_, each) for each in (shares, turned)))


def _parts(plan: Plan, swept: Swept) -> Iterator[Part]:
    """What crosses slices across z or y, and what crosses those across x: one after the other."""
    directions = tuple(direction for direction, _ in plan.weighted)
    for i, schedule in enumerate(schedules(plan.grid, directions)):
        yield Part(plan, schedule, swept, bool(i))
