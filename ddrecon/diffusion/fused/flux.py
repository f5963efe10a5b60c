"""The flux of E5 as one function of tensors, with its derivatives."""

from __future__ import annotations

import functools
from collections.abc import Callable
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
    total,
)
from ddrecon.diffusion.fused.flux_kernels import flux_adjoint_kernel, flux_kernel
from ddrecon.diffusion.operator import AXES, escape
from ddrecon.grid import Grid
from ddrecon.kernels.dual import launch_row_tangents, split
from ddrecon.kernels.rows import launch_rows
from ddrecon.light.moments import Vector
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_NAMES = "light_z", "light_y", "light_x"
_OTHERS = "begun_z", "begun_y", "begun_x", "more_z", "more_y", "more_x"
_TENSORS = "diffusion", "scattering_scale", "scattering", "outside", "mean", *_OTHERS, *FLUX
_NONE: tuple[Any, ...] = (None,) * 3


def find_flux(
    medium: Medium,
    diffusion: Tensor,
    flux: Vector | None,
    outside: Tensor,
    mean: Tensor,
    more: Vector | None = None,
    begun: Vector | None = None,
    sign: int = 1,
) -> Vector:
    """L1 of L0 = `mean` (E5, E6); `flux` is Q1, or all that is not in `more`.

    Times the `sign`, and added to a flux that is `begun`.
    """
    if flux is None:
        flux, more = more, None
    z, y, x = _Flux.apply(
        medium.grid,
        sign,
        diffusion,
        medium.remaining.scale,
        medium.remaining.field,
        outside,
        mean,
        *(begun or _NONE),
        *(more or _NONE),
        *(flux or ()),
    )
    return z, y, x


class _Flux(torch.autograd.Function):
    """L1 along z, y, x."""

    @staticmethod
    def forward(grid: Grid, sign: int, *tensors: Any) -> tuple[Tensor, ...]:
        mean = tensors[4]
        light = tuple(mean.new_empty(mean.shape) for _ in _NAMES)
        made = dict(zip(_NAMES, light, strict=True))
        launch_rows(_of(flux_kernel, *tensors), grid, len(mean), _given(sign, *tensors), made)
        return light

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.grid, ctx.sign, *tensors = inputs
        # Nothing depends on what a flux was that is begun.
        ctx.is_begun = tensors[5] is not None
        keep(ctx, *tensors[:5], *_NONE, *tensors[8:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        diffusion, scale, field, outside, mean, *others = ctx.saved_tensors
        more, flux = others[3:6], others[6:]
        _, needs_scale, _, needs_outside = ctx.needs_input_grad[2:6]
        scattering = FieldBar(scale, field, len(mean), needs_scale)
        found = empty_bars(len(mean), diffusion=diffusion, mean=mean, **name_flux(flux))
        given = _given(ctx.sign, *ctx.saved_tensors) | {"scattering_factor": scattering.factor}
        given |= {f"{name}_bar": bar for name, bar in zip(_NAMES, bars, strict=True)}
        kernel = _of(flux_adjoint_kernel, *ctx.saved_tensors)
        launch_rows(kernel, ctx.grid, len(mean), given, found | {"field_bar": scattering.bar})
        outside_bar = None
        if needs_outside:
            outside_bar = ctx.sign * _inflow_bar(bars, diffusion, ctx.grid, outside)
        return (
            *(None, None, sum_colors(found["diffusion_bar"], diffusion)),
            *(scattering.split() if flux else (None, None)),
            *(outside_bar, found["mean_bar"]),
            *(bars if ctx.is_begun else _NONE),
            *(_NONE if more[0] is None else (found[f"{name}_bar"] for name in FLUX)),
            *(sum_colors(found[f"{name}_bar"], flux[0]) for name in name_flux(flux)),
        )

    @staticmethod
    def jvp(ctx: Any, _grid: None, _sign: None, *changes: Tensor | None) -> tuple[Tensor, ...]:
        def change(*tensors: Any) -> tuple[Tensor, ...]:
            values, d_values = split(tensors)
            mean = values[4]
            made = {name: mean.new_empty(mean.shape) for name in _NAMES}
            given = _given(ctx.sign, *values) | {"is_begun": int(ctx.is_begun)}
            d_given = dict(zip(_TENSORS, d_values, strict=False))
            kernel = _of(flux_kernel, *values)
            launch_row_tangents(kernel, ctx.grid, len(mean), given, d_given, made)
            return tuple(made.values())

        d_light: tuple[Tensor, ...] = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_light


def _of(kernel: Callable[..., Any], *tensors: Any) -> Callable[[int], Any]:
    """The `kernel` for such tensors: whether there is Q1."""
    return functools.partial(kernel, len(tensors) > len(_TENSORS) - len(FLUX))


def _inflow_bar(bars: tuple[Tensor, ...], diffusion: Tensor, grid: Grid, outside: Tensor) -> Tensor:
    """The cotangent of the radiance `outside`, which E6 lets in: upwards at low ends."""
    found = torch.zeros_like(outside)
    for axis, bar, step in zip(AXES, bars, grid.spacing, strict=True):
        for place, sign in ((0, 1.5), (bar.shape[axis] - 1, -1.5)):
            part = escape(diffusion.narrow(axis, place, 1), step) * bar.narrow(axis, place, 1)
            found += sign * total(part, outside)
    return found


def _given(
    sign: int,
    diffusion: Tensor,
    scale: Tensor,
    field: Tensor,
    outside: Tensor,
    mean: Tensor,
    *fluxes: Any,
) -> dict[str, Any]:
    """What both kernels are given, by its names; others stand for arrays that are not."""
    others, flux = fluxes[: len(_OTHERS)], fluxes[len(_OTHERS) :]
    begun, more = others[:3], others[3:]
    stand_ins = mean, mean, mean, *(flux or (mean, mean, mean))
    return {
        "own": len(diffusion), "scattering_fields": len(field),
        "sources": len(flux[0]) if flux else 1,
        "times": 3 * sign, "is_begun": int(begun[0] is not None),
        "has_more": int(more[0] is not None),
        "diffusion": diffusion, "scattering_scale": per_color(scale, len(mean)),
        "scattering": field, "outside": per_color(outside, len(mean)), "mean": mean,
        **name_flux(flux),
        **{
            name: stand_in if other is None else other
            for name, other, stand_in in zip(_OTHERS, others, stand_ins, strict=True)
        },
    }  # fmt: skip
