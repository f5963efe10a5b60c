"""A sweep as one differentiable function of tensors, by fused kernels (E2.9, E2.8)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.light.moments import Cut, by_harmonic, cut
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly
from ddrecon.numerics.remember import remember
from ddrecon.transport.fused.rows import Rows
from ddrecon.transport.fused.swept import Swept


def sweep_fused(
    medium: Medium,
    light: Cut,
    factors: Tensor,
    source: Cut,
    gradient: Tensor,
    inflow: Tensor | None,
    directions: int,
) -> Cut:
    """The moments of the radiance that `light`, by `factors`, and `source` scatter (E2.8).

    Those of degrees 0 and 1 less those of `light`. `gradient`: of what scatters alike everywhere,
    as of `gradient_within`; `directions`: how many the quadrature has.
    """
    colors, cells = light[0].shape[1], light[0].shape[2:]
    shares_field = medium.remaining.field is medium.extinction.field
    fields = medium.extinction.field, None if shares_field else medium.remaining.field
    low, high, _ = _Sweep.apply(
        torch.is_grad_enabled(),
        medium.grid,
        directions,
        _scales(medium.extinction.scale, medium.remaining.scale, inflow, colors),
        *fields,
        gradient.expand(3, colors, *cells),
        _spread_factors(factors, colors),
        *light,
        *(one.expand(-1, colors, *cells) for one in source),
    )
    return low, high


@remember
def _scales(extinction: Tensor, scattering: Tensor, inflow: Tensor | None, colors: int) -> Tensor:
    """Of extinction, of scattering that remains, and the inflow of each of `colors`, [3, C]."""
    entering = torch.zeros_like(extinction) if inflow is None else inflow
    each = extinction, scattering, entering
    return torch.stack([one.reshape(-1).expand(colors) for one in each])


@remember
def _spread_factors(factors: Tensor, colors: int) -> Tensor:
    """`factors` [L + 1, 1 or C, 1, 1, 1] by harmonic, [K, C]."""
    return by_harmonic(factors.reshape(len(factors), -1).expand(-1, colors), len(factors) - 1)


class _Sweep(torch.autograd.Function):
    """The moments of light, and their derivatives by all tensors of `Swept`.

    The last is what `Rows` saves for the backward pass, where gradients may be asked for.
    """

    @staticmethod
    def forward(may_save: bool, *given: Any) -> tuple[Any, ...]:
        tensors = (each for each in given if isinstance(each, Tensor))
        is_saved = may_save and any(each.requires_grad for each in tensors)
        scales = given[2]
        phi, saved = Rows(Swept.of(*given)).follow(is_saved, scales.requires_grad)
        return *cut(phi), saved

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        _, grid, directions, *tensors = inputs
        ctx.of, ctx.saved = (grid, directions), output[-1]
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(*([] if ctx.saved is None else [ctx.saved]))
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor | None) -> tuple[Any, ...]:
        swept = Swept.of(*ctx.of, *ctx.saved_tensors)
        _, _, _, needs_scales, _, _, _, needs_factors, *_ = ctx.needs_input_grad
        low_bar, high_bar, _ = bars
        scales_bar, phi_bar, gradient_bar, fields = Rows(swept).transpose(
            ctx.saved, (low_bar, high_bar), needs_scales
        )
        extinction_bar, *scattering_bar = fields
        source_bars = zip(cut(phi_bar), ctx.saved_tensors[-2:], strict=True)
        return (
            None,
            None,
            None,
            scales_bar if needs_scales else None,
            extinction_bar,
            scattering_bar[0] if scattering_bar else None,
            gradient_bar,
            swept.factor_bar(phi_bar) if needs_factors else None,
            *swept.light_bars(phi_bar, (low_bar, high_bar)),
            *(bar[: len(one)] for bar, one in source_bars),
        )

    @staticmethod
    def jvp(ctx: Any, *changes: Any) -> tuple[Tensor | None, ...]:
        def change(*tensors: Any) -> Cut:
            half = len(tensors) // 2
            swept = Swept.of(*ctx.of, *tensors[:half])
            d_swept = swept.changes(*tensors[half:])
            return cut(Rows(swept, d_swept).follow()[0])

        return *run_plainly(change, *ctx.saved_tensors, *changes[3:]), None
