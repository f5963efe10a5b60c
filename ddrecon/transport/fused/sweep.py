"""A sweep as one differentiable function of tensors, by fused kernels (E2.9, E2.8)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, is_forward, keep, run_plainly
from ddrecon.numerics.harmonics import degrees_on
from ddrecon.numerics.remember import remember
from ddrecon.transport.fused.rows import Rows
from ddrecon.transport.fused.swept import (
    PARTS,
    Parts,
    Swept,
    parts_of,
    split,
    units_of_parts,
)


def sweep_fused(
    medium: Medium,
    light: Moments,
    factors: Tensor,
    source: Moments,
    gradient: Tensor,
    inflow: Tensor | None,
    directions: int,
) -> Moments:
    """The moments of the radiance that `light`, by `factors`, and `source` scatter (E2.8).

    The first two less those of `light`. `gradient`: of what scatters alike everywhere, as of
    `gradient_within`; `directions`: how many the quadrature has.
    """
    colors, beam_factors = len(light.mean), None
    if is_forward():  # where a beam and its factors may both change
        source = source.spelled()
    if source.beam is not None:
        beam, each = source.beam
        # The parts of light are so many times its moments.
        units = units_of_parts(len(factors) - 1)[:, None].to(factors)
        source, beam_factors = Moments(beam), (units * each).expand(-1, colors)
    shares_field = medium.remaining.field is medium.extinction.field
    fields = medium.extinction.field, None if shares_field else medium.remaining.field
    mean, z, y, x, higher, _ = _Sweep.apply(
        torch.is_grad_enabled(),
        medium.grid,
        directions,
        _scales(medium.extinction.scale, medium.remaining.scale, inflow, colors),
        *fields,
        gradient.expand(3, colors, *light.mean.shape[1:]),
        _spread_factors(factors, colors),
        beam_factors,
        *parts_of(light, colors),
        *parts_of(source, colors),
    )
    return Moments(mean, None if z is None else (z, y, x), higher)


@remember
def _scales(extinction: Tensor, scattering: Tensor, inflow: Tensor | None, colors: int) -> Tensor:
    """Of extinction, of scattering that remains, and the inflow of each of `colors`, [3, C]."""
    entering = torch.zeros_like(extinction) if inflow is None else inflow
    each = extinction, scattering, entering
    return torch.stack([one.reshape(-1).expand(colors) for one in each])


@remember
def _spread_factors(factors: Tensor, colors: int) -> Tensor:
    """`factors` [L + 1, 1 or C, 1, 1, 1] by harmonic, [K, C]."""
    degrees = degrees_on(factors.device, len(factors) - 1)
    return factors.reshape(len(factors), -1).expand(-1, colors).index_select(0, degrees)


class _Sweep(torch.autograd.Function):
    """The parts of light, and their derivatives by all tensors of `Swept`.

    The last is what `Rows` saves for the backward pass, where gradients may be asked for.
    """

    @staticmethod
    def forward(may_save: bool, *given: Any) -> tuple[Any, ...]:
        tensors = (each for each in given if isinstance(each, Tensor))
        is_saved = may_save and any(each.requires_grad for each in tensors)
        scales = given[2]
        moments, saved = Rows(Swept.of(*given)).follow(is_saved, scales.requires_grad)
        return *split(moments), saved

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
        _, _, _, needs_scales, _, _, _, needs_factors, *needs_more = ctx.needs_input_grad
        needs_beam_factors, *needs_parts = needs_more
        parts = bars[:-1]
        scales_bar, moments_bar, gradient_bar, fields = Rows(swept).transpose(
            ctx.saved, parts, needs_scales
        )
        extinction_bar, *scattering_bar = fields
        return (
            None,
            None,
            None,
            scales_bar if needs_scales else None,
            extinction_bar,
            scattering_bar[0] if scattering_bar else None,
            gradient_bar,
            swept.factor_bar(moments_bar) if needs_factors else None,
            swept.beam_factor_bar(moments_bar) if needs_beam_factors else None,
            *swept.light_bars(moments_bar, parts, needs_parts[:PARTS]),
            *swept.source_bars(moments_bar, needs_parts[PARTS:]),
        )

    @staticmethod
    def jvp(ctx: Any, *changes: Any) -> tuple[Tensor | None, ...]:
        def change(*tensors: Any) -> Parts:
            half = len(tensors) // 2
            swept = Swept.of(*ctx.of, *tensors[:half])
            d_swept = swept.changes(*tensors[half:])
            return split(Rows(swept, d_swept).follow()[0])

        return *run_plainly(change, *ctx.saved_tensors, *changes[3:]), None
