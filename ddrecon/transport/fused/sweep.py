"""A sweep as one differentiable function of tensors, by fused kernels (E2.9, E2.8)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly
from ddrecon.numerics.remember import remember
from ddrecon.transport.fused.launches import Ordinates, Sweep, Swept


def sweep_fused(
    medium: Medium, source: Tensor, gradient: Tensor, inflow: Tensor | None, directions: int
) -> Tensor:
    """As `sweep` in `transport/sweep.py`, where light enters by no face but as `inflow`."""
    return _apply(medium, source, gradient, inflow, (medium.grid, directions, None), None)[0]


def sweep_chunk(
    medium: Medium,
    source: Tensor,
    gradient: Tensor,
    inflow: Tensor | None,
    directions: int,
    chunk: int,
    entering: Tensor,
) -> tuple[Tensor, Tensor]:
    """The moments of a `chunk` of ordinates, and light where it leaves cells, less `inflow`.

    That, and what is `entering` cells from outside, are rings (`ordinates.h`)
    [ordinates, C, planes, y + 2, x + 2].
    """
    return _apply(medium, source, gradient, inflow, (medium.grid, directions, chunk), entering)


def _apply(
    medium: Medium,
    source: Tensor,
    gradient: Tensor,
    inflow: Tensor | None,
    of: Ordinates,
    entering: Tensor | None,
) -> Any:
    extinction, remaining = medium.extinction, medium.remaining
    scales = _stack_scales(extinction.scale, remaining.scale, inflow, source.shape[1])
    scattering = None if remaining.field is extinction.field else remaining.field
    gradient = gradient.expand(3, *source.shape[1:])
    tensors = scales, extinction.field, scattering, gradient, source, entering
    return _Sweep.apply(torch.is_grad_enabled(), of, *tensors)


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
    scales, extinction, scattering, gradient, source = tensors
    scattering = extinction if scattering is None else scattering
    fields = scales, extinction, scattering, gradient, source
    return Swept(*(field.contiguous() for field in fields))


def _of_field(bar: Tensor, scale: Tensor, field: Tensor) -> Tensor:
    """The cotangent of a `field`, of that of `scale` times the field, [C, z, y, x]."""
    if len(field) == 1:
        return torch.tensordot(scale, bar, 1)[None]
    return scale.view(-1, 1, 1, 1) * bar


class _Sweep(torch.autograd.Function):
    """The moments of radiance, with derivatives by all tensors of `Swept` and what is entering.

    The second result is light as of `sweep_chunk`, or of no use but to the backward pass.
    """

    @staticmethod
    def forward(may_save: bool, of: Ordinates, *tensors: Any) -> tuple[Tensor, Tensor | None]:
        *fields, entering = tensors
        saves = may_save and any(one is not None and one.requires_grad for one in tensors)
        return Sweep(of, _swept(fields)).follow(saves, entering)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        _, ctx.of, *tensors = inputs
        ctx.saved = output[1] if tensors[-1] is None else None
        ctx.mark_non_differentiable(*([] if ctx.saved is None else [ctx.saved]))
        ctx.set_materialize_grads(False)
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bars: Tensor | None, light_bar: Tensor | None) -> tuple[Any, ...]:
        *fields, entering = ctx.saved_tensors
        swept = _swept(fields)
        bars = torch.zeros_like(swept.source) if bars is None else bars.contiguous()
        returning = None
        if entering is not None:
            # The cotangent of what enters takes the place of that of light.
            returning = torch.zeros_like(entering) if light_bar is None else light_bar.clone()
        inflow, mass, scattered, gradient, source = Sweep(ctx.of, swept).go_back(
            bars, ctx.saved, entering, returning
        )
        scales_bar = None
        if ctx.needs_input_grad[2]:
            pairs = (mass, swept.extinction), (scattered, swept.scattering)
            sums = [(bar * field).sum((1, 2, 3), dtype=torch.float64) for bar, field in pairs]
            scales_bar = torch.stack([*(one.to(inflow) for one in sums), inflow])
        of_extinction, of_scattering = (
            _of_field(bar, scale, field)
            for bar, scale, field in zip(
                (mass, scattered), swept.scales, (swept.extinction, swept.scattering), strict=False
            )
        )
        of_fields: tuple[Tensor, Tensor | None] = of_extinction, of_scattering
        if fields[2] is None:
            of_fields = of_extinction + of_scattering, None
        return None, None, scales_bar, *of_fields, gradient, source, returning

    @staticmethod
    def jvp(ctx: Any, *changes: Any) -> tuple[Tensor, Tensor | None]:
        def change(*tensors: Any) -> Any:
            half = len(tensors) // 2
            values, entering = tensors[: half - 1], tensors[half - 1]
            *d_fields, d_entering = (
                value if value is None else torch.zeros_like(value) if d is None else d
                for value, d in zip(tensors[:half], tensors[half:], strict=True)
            )
            if d_entering is not None:
                entering = torch.stack([entering, d_entering], 3)
            sweep = Sweep(ctx.of, _swept(values), _swept(d_fields))
            moments, light = sweep.follow(entering=entering)
            return moments if light is None else (moments, light[:, :, :, 1].contiguous())

        found = run_plainly(change, *ctx.saved_tensors, *changes[2:])
        return found if isinstance(found, tuple) else (found, None)
