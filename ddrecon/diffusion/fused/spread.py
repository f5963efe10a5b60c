"""What a flux of scattered light adds to the right side of E4, by fused kernels."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.fused.colors import (
    FLUX,
    FieldBar,
    empty_bars,
    name_flux,
    per_color,
    remaining_scale,
    sum_colors,
)
from ddrecon.diffusion.fused.faces import FACES
from ddrecon.diffusion.fused.system_kernels import system_adjoint_kernel
from ddrecon.grid import Grid
from ddrecon.kernels.dual import launch_row_tangents, split
from ddrecon.kernels.rows import launch_rows, row_kernel
from ddrecon.light.moments import Vector
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_SPREAD = """
const F* s_field = scattering + color(scattering_fields, size) + start;
const F* d = diffusion + color(own, size) + start;
const long long q = color(sources, size) + start;
const F *qz = flux_z + q, *qy = flux_y + q, *qx = flux_x + q;
const F S = scattering_scale[c];
F* out = right + c * size + start;
each([&](int i, bool xl, bool xh, int to_xl, int to_xh) INLINE {
    const F a = d[i], s = S * s_field[i];
    auto along = [&](const F* flux, long long low, long long high, F h,
                     bool has_low, bool has_high) INLINE -> F {
        const F p = s * flux[i];
        const F p_low = S * s_field[i + low] * flux[i + low];
        const F p_high = S * s_field[i + high] * flux[i + high];
        const F lower = share(a, d[i + low], h, has_low) * driven(p, p_low, h, has_low);
        const F upper = share(a, d[i + high], h, has_high) * driven(p, p_high, h, has_high);
        return F(2) * a * (lower - upper) / h;
    };
    out[i] = along(qz, to_zl, to_zh, hz, zl, zh) + along(qy, to_yl, to_yh, hy, yl, yh)
           + along(qx, to_xl, to_xh, hx, xl, xh);
});
"""
_TENSORS = "diffusion", "scattering_scale", "scattering", *FLUX
_UNUSED = "conductance_z", "conductance_y", "conductance_x", "loss"


def spread_flux(medium: Medium, diffusion: Tensor, flux: Vector) -> Tensor:
    """- div(D kappa_s `flux`) [C, z, y, x]."""
    right: Tensor = _Spread.apply(
        medium.grid, diffusion, remaining_scale(medium), medium.scattering.field, *flux
    )
    return right


class _Spread(torch.autograd.Function):
    """- div(D kappa_s Q1), from D, the scale and the field of kappa_s, and Q1 along z, y, x."""

    @staticmethod
    def forward(grid: Grid, *tensors: Tensor) -> Tensor:
        right = _empty(*tensors)
        launch_rows(spread_kernel, grid, len(right), _given(*tensors), {"right": right})
        return right

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.grid, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, right_bar: Tensor) -> tuple[Tensor | None, ...]:
        # The adjoint of the whole system, of whose results only the right side has a cotangent.
        diffusion, scale, field, *flux = ctx.saved_tensors
        colors, nothing = len(right_bar), torch.zeros_like(right_bar)
        scattering = FieldBar(scale, field, colors, ctx.needs_input_grad[2])
        found = empty_bars(colors, diffusion=diffusion, **name_flux(flux))
        none = {"absorption_fields": 1, "absorption": field, "mean": nothing}
        none |= {f"{name}_bar": nothing for name in _UNUSED}
        given = _given(*ctx.saved_tensors) | none | {"right_bar": right_bar}
        given |= {"outside": nothing.new_zeros(colors), "scattering_factor": scattering.factor}
        given |= {"absorption_scale": given["outside"], "absorption_factor": given["outside"]}
        made = {**found, "mean_bar": torch.empty_like(right_bar), "field_bar": scattering.bar}
        kernel = functools.partial(system_adjoint_kernel, True)
        launch_rows(kernel, ctx.grid, colors, given, made)
        diffusion_bar, *flux_bars = (
            sum_colors(bar, like)
            for bar, like in zip(found.values(), (diffusion, *flux), strict=True)
        )
        return None, diffusion_bar, *scattering.split(), *flux_bars

    @staticmethod
    def jvp(ctx: Any, _: None, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            values, d_values = split(tensors)
            d_right, d_given = _empty(*values), dict(zip(_TENSORS, d_values, strict=True))
            given, made = _given(*values), {"right": d_right}
            launch_row_tangents(spread_kernel, ctx.grid, len(d_right), given, d_given, made)
            return d_right

        d_right: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_right


def _empty(diffusion: Tensor, _scale: Tensor, _field: Tensor, *flux: Tensor) -> Tensor:
    """Room for the right side."""
    return flux[0].new_empty(max(len(diffusion), len(flux[0])), *flux[0].shape[1:])


def _given(diffusion: Tensor, scale: Tensor, field: Tensor, *flux: Tensor) -> dict[str, Any]:
    """What kernels are given, by its names."""
    colors = max(len(diffusion), len(flux[0]))
    return {
        "own": len(diffusion),
        "scattering_fields": len(field),
        "sources": len(flux[0]),
        "diffusion": diffusion,
        "scattering_scale": per_color(scale, colors),
        "scattering": field,
        **name_flux(flux),
    }


@functools.cache
def spread_kernel(bits: int) -> Any:
    """The kernel of what a flux adds."""
    arrays = "diffusion scattering_scale scattering flux_z flux_y flux_x right"
    numbers = "own scattering_fields sources"
    return row_kernel("spread_flux", bits, FACES + _SPREAD, arrays, numbers)
