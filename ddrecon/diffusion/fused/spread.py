"""What the flux of a source adds to the right side of E4, in one pass; with its derivatives.

That is the part of `system_kernels.py` that is linear in Q1: - div(D kappa_s Q1).
"""

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
    sum_colors,
)
from ddrecon.diffusion.fused.faces import FACES
from ddrecon.grid import Grid
from ddrecon.kernels.dual import launch_row_tangents
from ddrecon.kernels.rows import launch_rows, row_kernel
from ddrecon.light.moments import Vector
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_ROWS = """
const F* d = diffusion + color(own, size) + start;
const F* field = scattering + color(scattering_fields, size) + start;
const long long to = c * size + start;
const F *qz = flux_z + to, *qy = flux_y + to, *qx = flux_x + to, S = scattering_scale[c];
"""
_SPREAD = """
F* out = spread + to;
const F *one = begun + to, *other = begun_more + to;
each([&](int i, bool xl, bool xh, int to_xl, int to_xh) HERE {
    const F a = d[i], s = S * field[i];
    // What enters through the lower face along an axis, less what leaves through the upper one.
    auto along = [&](const F* flux, long long low, long long high, F h, bool has_low,
                     bool has_high) HERE -> F {
        const F p = s * flux[i], p_low = S * field[i + low] * flux[i + low];
        const F p_high = S * field[i + high] * flux[i + high];
        return F(2) * a / h
            * (share(a, d[i + low], h, has_low) * driven(p, p_low, h, has_low)
               - share(a, d[i + high], h, has_high) * driven(p, p_high, h, has_high));
    };
    const F gained = along(qz, to_zl, to_zh, hz, zl, zh) + along(qy, to_yl, to_yh, hy, yl, yh)
        + along(qx, to_xl, to_xh, hx, xl, xh);
    out[i] = one[i] + other[i] + gained;
});
"""
_ADJOINT = """
const F *r = spread_bar + to, factor = scattering_factor[c];
F *d_bars = diffusion_bar + to, *field_bars = field_bar + to;
F *qz_bars = flux_z_bar + to, *qy_bars = flux_y_bar + to, *qx_bars = flux_x_bar + to;
each([&](int i, bool xl, bool xh, int to_xl, int to_xh) HERE {
    const F a = d[i], s = S * field[i], here = r[i];
    F d_bar = F(0);
    // Both faces along an axis; returns the cotangent of kappa_s Q1.
    auto along = [&](const F* flux, long long low, long long high, F h, bool has_low,
                     bool has_high) HERE -> F {
        const F t_low = share(a, d[i + low], h, has_low);
        const F t_high = share(a, d[i + high], h, has_high);
        const F p = s * flux[i], p_low = S * field[i + low] * flux[i + low];
        const F p_high = S * field[i + high] * flux[i + high];
        const F lower = (here - (has_low ? r[i + low] : F(0))) / h;
        const F upper = ((has_high ? r[i + high] : F(0)) - here) / h;
        d_bar += F(2)
            * (t_low * t_low * lower * driven(p, p_low, h, has_low) * (has_low ? F(1) : h)
               + t_high * t_high * upper * driven(p, p_high, h, has_high) * (has_high ? F(1) : h));
        return a * (t_low * lower * (has_low ? F(1) : h) + t_high * upper * (has_high ? F(1) : h));
    };
    const F pz_bar = along(qz, to_zl, to_zh, hz, zl, zh);
    const F py_bar = along(qy, to_yl, to_yh, hy, yl, yh);
    const F px_bar = along(qx, to_xl, to_xh, hx, xl, xh);
    d_bars[i] = d_bar;
    field_bars[i] = factor * (qz[i] * pz_bar + qy[i] * py_bar + qx[i] * px_bar);
    qz_bars[i] = s * pz_bar;
    qy_bars[i] = s * py_bar;
    qx_bars[i] = s * px_bar;
});
"""
_BEGUN = "begun", "begun_more"
_TENSORS = "diffusion", "scattering_scale", "scattering", *FLUX, *_BEGUN
_GIVEN = " ".join(_TENSORS) + " "


def spread_flux(
    medium: Medium, diffusion: Tensor, flux: Vector, begun: tuple[Tensor, Tensor]
) -> Tensor:
    """The sum of what is `begun`, less div(D kappa_s `flux`), all [C, z, y, x]."""
    scale, field = medium.remaining.scale, medium.remaining.field
    spread: Tensor = _Spread.apply(medium.grid, diffusion, scale, field, *flux, *begun)
    return spread


class _Spread(torch.autograd.Function):
    """What a flux adds to what is begun of a right side."""

    @staticmethod
    def forward(grid: Grid, *tensors: Tensor) -> Tensor:
        flux = tensors[3]
        spread = flux.new_empty(flux.shape)
        launch_rows(spread_kernel, grid, len(flux), _given(*tensors), {"spread": spread})
        return spread

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.grid, *tensors = inputs
        keep(ctx, *tensors[: -len(_BEGUN)])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        diffusion, scale, field, *flux = ctx.saved_tensors
        scattering = FieldBar(scale, field, len(bar), ctx.needs_input_grad[2])
        found = empty_bars(len(bar), diffusion=diffusion, **name_flux(flux))
        given = _given(*ctx.saved_tensors)
        given |= {"scattering_factor": scattering.factor, "spread_bar": bar}
        made = found | {"field_bar": scattering.bar}
        launch_rows(spread_adjoint_kernel, ctx.grid, len(bar), given, made)
        diffusion_bar = sum_colors(found["diffusion_bar"], diffusion)
        flux_bars = (found[f"{name}_bar"] for name in FLUX)
        return None, diffusion_bar, *scattering.split(), *flux_bars, bar, bar

    @staticmethod
    def jvp(ctx: Any, _: None, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            count = len(_TENSORS) - len(_BEGUN)
            values, d_values = tensors[:count], tensors[count:]
            d_spread = values[3].new_empty(values[3].shape)
            given, d_given = _given(*values), dict(zip(_TENSORS, d_values, strict=True))
            made = {"spread": d_spread}
            launch_row_tangents(spread_kernel, ctx.grid, len(d_spread), given, d_given, made)
            return d_spread

        d_spread: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_spread


def _given(diffusion: Tensor, scale: Tensor, field: Tensor, *others: Tensor) -> dict[str, Any]:
    """What both kernels are given, by its names."""
    flux = others[: len(FLUX)]
    # Only the values depend on what is begun: nothing else reads it.
    begun = others[len(FLUX) :] or flux[: len(_BEGUN)]
    return {
        "own": len(diffusion), "scattering_fields": len(field), "diffusion": diffusion,
        "scattering_scale": per_color(scale, len(flux[0])), "scattering": field,
        **name_flux(flux), **dict(zip(_BEGUN, begun, strict=True)),
    }  # fmt: skip


@functools.cache
def spread_kernel(bits: int) -> Any:
    """The kernel of what a flux adds to what is begun."""
    text = FACES + _ROWS + _SPREAD
    return row_kernel("spread_flux", bits, text, _GIVEN, "spread", "own scattering_fields")


@functools.cache
def spread_adjoint_kernel(bits: int) -> Any:
    """The kernel of cotangents, in all colors; `field_bar` as in `system_kernels.py`."""
    text, arrays = FACES + _ROWS + _ADJOINT, _GIVEN + "spread_bar scattering_factor"
    made = "diffusion_bar field_bar flux_z_bar flux_y_bar flux_x_bar"
    return row_kernel("spread_adjoint", bits, text, arrays, made, "own scattering_fields")
