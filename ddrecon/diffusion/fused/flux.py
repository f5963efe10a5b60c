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
_BEGUN = "begun_z", "begun_y", "begun_x"
_TENSORS = (
    *("diffusion", "scattering_scale", "scattering", "outside", "mean"),
    *(*_BEGUN, *FLUX),
)


def find_flux(
    medium: Medium,
    diffusion: Tensor,
    flux: Vector | None,
    outside: Tensor,
    mean: Tensor,
    begun: Vector | None = None,
) -> Vector:
    """L1 of L0 = `mean` (E5, E6); `flux` is Q1.

    With a flux that is `begun`, by how much it is off that.
    """
    z, y, x = _Flux.apply(
        medium.grid,
        diffusion,
        medium.remaining.scale,
        medium.remaining.field,
        outside,
        mean,
        *(begun or (None, None, None)),
        *(flux or ()),
    )
    return z, y, x


class _Flux(torch.autograd.Function):
    """L1 along z, y, x."""

    @staticmethod
    def forward(grid: Grid, *tensors: Tensor) -> tuple[Tensor, ...]:
        mean = tensors[4]
        light = tuple(mean.new_empty(mean.shape) for _ in _NAMES)
        made = dict(zip(_NAMES, light, strict=True))
        launch_rows(_of(flux_kernel, *tensors), grid, len(mean), _given(*tensors), made)
        return light

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.grid, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        diffusion, scale, field, outside, mean, begun, _, _, *flux = ctx.saved_tensors
        _, needs_scale, _, needs_outside = ctx.needs_input_grad[1:5]
        scattering = FieldBar(scale, field, len(mean), needs_scale)
        found = empty_bars(len(mean), diffusion=diffusion, mean=mean, **name_flux(flux))
        given = _given(*ctx.saved_tensors) | {"scattering_factor": scattering.factor}
        given |= {f"{name}_bar": bar for name, bar in zip(_NAMES, bars, strict=True)}
        kernel = _of(flux_adjoint_kernel, *ctx.saved_tensors)
        launch_rows(kernel, ctx.grid, len(mean), given, found | {"field_bar": scattering.bar})
        scattering_bars = scattering.split() if flux else (None, None)
        outside_bar = None
        if needs_outside:
            outside_bar = _inflow_bar(bars, diffusion, ctx.grid, outside)
            outside_bar = outside_bar if begun is None else -outside_bar
        diffusion_bar, mean_bar, *flux_bars = (
            sum_colors(bar, like)
            for bar, like in zip(found.values(), (diffusion, mean, *flux), strict=True)
        )
        begun_bars = (None,) * 3 if begun is None else bars
        return None, diffusion_bar, *scattering_bars, outside_bar, mean_bar, *begun_bars, *flux_bars

    @staticmethod
    def jvp(ctx: Any, _: None, *changes: Tensor | None) -> tuple[Tensor, ...]:
        def change(*tensors: Any) -> tuple[Tensor, ...]:
            values, d_values = split(tensors)
            mean = values[4]
            made = {name: mean.new_empty(mean.shape) for name in _NAMES}
            given, d_given = _given(*values), dict(zip(_TENSORS, d_values, strict=False))
            kernel = _of(flux_kernel, *values)
            launch_row_tangents(kernel, ctx.grid, len(mean), given, d_given, made)
            return tuple(made.values())

        d_light: tuple[Tensor, ...] = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_light


def _of(kernel: Callable[..., Any], *tensors: Any) -> Callable[[int], Any]:
    """The `kernel` for such tensors: whether there is Q1, and whether a flux is begun."""
    return functools.partial(kernel, len(tensors) > 8, tensors[5] is not None)


def _inflow_bar(bars: tuple[Tensor, ...], diffusion: Tensor, grid: Grid, outside: Tensor) -> Tensor:
    """The cotangent of the radiance `outside`, which E6 lets in: upwards at low ends."""
    found = torch.zeros_like(outside)
    for axis, bar, step in zip(AXES, bars, grid.spacing, strict=True):
        for place, sign in ((0, 1.5), (bar.shape[axis] - 1, -1.5)):
            part = escape(diffusion.narrow(axis, place, 1), step) * bar.narrow(axis, place, 1)
            found += sign * total(part, outside)
    return found


def _given(
    diffusion: Tensor,
    scale: Tensor,
    field: Tensor,
    outside: Tensor,
    mean: Tensor,
    *fluxes: Tensor | None,
) -> dict[str, Any]:
    """What both kernels are given, by its names."""
    begun, flux = fluxes[:3], fluxes[3:]
    return {
        "own": len(diffusion),
        "scattering_fields": len(field),
        "sources": len(flux[0]) if flux else 1,
        "diffusion": diffusion,
        "scattering_scale": per_color(scale, len(mean)),
        "scattering": field,
        "outside": per_color(outside, len(mean)),
        "mean": mean,
        **dict(zip(_BEGUN, begun, strict=True)),
        **name_flux(flux),
    }
