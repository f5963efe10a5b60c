"""A sweep as one differentiable function of tensors, by fused kernels (E2.9, E2.8)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly
from ddrecon.numerics.remember import remember
from ddrecon.transport.fused.launches import Sweep, Swept


def sweep_fused(
    medium: Medium, source: Tensor, gradient: Tensor, inflow: Tensor | None, directions: int
) -> Tensor:
    """As `sweep` in `transport/sweep.py`, without mirrors and periods."""
    extinction, remaining = medium.extinction, medium.remaining
    shares_field = remaining.field is extinction.field
    scales = _stack_scales(extinction.scale, remaining.scale, inflow, source.shape[1])
    moments, _ = _Sweep.apply(
        torch.is_grad_enabled(),
        medium.grid,
        directions,
        scales,
        extinction.field,
        None if shares_field else remaining.field,
        gradient.expand(3, *source.shape[1:]),
        source,
    )
    return moments


@remember
def _stack_scales(
    extinction: Tensor, scattering: Tensor, inflow: Tensor | None, colors: int
) -> Tensor:
    """Factors of extinction and of scattering that remains, and inflow, [3, C]."""
    entering = torch.zeros_like(extinction) if inflow is None else inflow
    scales = extinction, scattering, entering
    return torch.stack([scale.reshape(-1).expand(colors) for scale in scales])


def _swept(tensors: Any) -> Swept:
    """From tensors as autograd must be given them: one by one, None for a field that is shared."""
    scales, extinction, scattering, gradient, source = (
        one if one is None else one.contiguous() for one in tensors
    )
    scattering = extinction if scattering is None else scattering
    return Swept(scales, extinction, scattering, gradient, source)


class _Sweep(torch.autograd.Function):
    """The moments of radiance, with derivatives by all tensors of `Swept`.

    The second is what `Sweep.follow` saves for the backward pass, where gradients may be asked for.
    """

    @staticmethod
    def forward(
        may_save: bool, grid: Grid, directions: int, *tensors: Any
    ) -> tuple[Tensor, Tensor | None]:
        saves = may_save and any(one is not None and one.requires_grad for one in tensors)
        return Sweep(grid, directions, _swept(tensors)).follow(saves)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        _, grid, directions, *tensors = inputs
        ctx.of, ctx.saved = (grid, directions), output[1]
        ctx.mark_non_differentiable(*([] if ctx.saved is None else [ctx.saved]))
        ctx.set_materialize_grads(False)
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bars: Tensor | None, _: None) -> tuple[Any, ...]:
        if bars is None:
            return (None,) * 8
        scales, extinction, scattering, *_ = ctx.saved_tensors
        swept, needs_scales = _swept(ctx.saved_tensors), ctx.needs_input_grad[3]
        inflow, mass, scattered, gradient, source = Sweep(*ctx.of, swept).go_back(
            bars.contiguous(), ctx.saved
        )
        scales_bar = None
        if needs_scales:
            pairs = (mass, extinction), (scattered, swept.scattering)
            sums = [(bar * field).sum((1, 2, 3), dtype=torch.float64) for bar, field in pairs]
            scales_bar = torch.stack([*(one.to(inflow) for one in sums), inflow])
        mass, scattered = (
            bar * scale.view(-1, 1, 1, 1)
            for bar, scale in zip((mass, scattered), scales[:2], strict=True)
        )
        if scattering is None:
            return (
                None,
                None,
                None,
                scales_bar,
                (mass + scattered).sum_to_size(extinction.shape),
                None,
                gradient,
                source,
            )
        of_fields = mass.sum_to_size(extinction.shape), scattered.sum_to_size(scattering.shape)
        return None, None, None, scales_bar, *of_fields, gradient, source

    @staticmethod
    def jvp(ctx: Any, *changes: Any) -> tuple[Tensor, None]:
        def change(*tensors: Any) -> Tensor:
            half = len(tensors) // 2
            values, d_values = tensors[:half], tensors[half:]
            d_values = tuple(
                value if value is None else torch.zeros_like(value) if d is None else d
                for value, d in zip(values, d_values, strict=True)
            )
            return Sweep(*ctx.of, _swept(values), _swept(d_values)).follow()[0]

        return run_plainly(change, *ctx.saved_tensors, *changes[3:]), None
