"""A sweep as one differentiable function of tensors, by fused kernels (E11, E12)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.part import Part, Plan, Swept, Weighted
from ddrecon.diffusion.rounds.fused.schedule import schedules
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium


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
        swept = Swept.of(*tensors)
        return tuple(_sum([part.follow() for part in _parts(plan, swept)]))

    @staticmethod
    def backward(ctx: Any, *bars: Tensor) -> tuple[Any, ...]:
        swept = Swept.of(*ctx.saved_tensors)
        varies_numbers = ctx.needs_input_grad[1]
        found: list[Any] = _sum(
            [part.transpose(bars, varies_numbers) for part in _parts(ctx.plan, swept)]
        )
        if swept.scattering is None:
            found.insert(2, None)
        return None, *found


def _parts(plan: Plan, swept: Swept) -> list[Part]:
    found = schedules(plan.grid, tuple(direction for direction, _ in plan.weighted))
    return [
        Part(plan, schedule, swept, is_turned)
        for is_turned, schedule in zip((False, True), found, strict=True)
        if schedule is not None
    ]


def _sum(parts: Sequence[list[Tensor]]) -> list[Tensor]:
    return [functools.reduce(Tensor.add_, tensors) for tensors in zip(*parts, strict=True)]
