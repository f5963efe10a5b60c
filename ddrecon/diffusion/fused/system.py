"""The system of E7 as one function of tensors, with its derivatives."""

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
    total,
)
from ddrecon.diffusion.fused.system_kernels import system_adjoint_kernel, system_kernel
from ddrecon.diffusion.operator import boundary_loss
from ddrecon.grid import Grid
from ddrecon.kernels.dual import launch_row_tangents, split
from ddrecon.kernels.rows import launch_rows
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_NAMES = "conductance_z", "conductance_y", "conductance_x", "loss", "right"
_TENSORS = (
    *("diffusion", "absorption_scale", "absorption", "scattering_scale", "scattering"),
    *("outside", "mean", *FLUX),
)


def assemble_system(
    medium: Medium, diffusion: Tensor, source: Moments, outside: Tensor
) -> tuple[Tensor, ...]:
    """Conductances along z, y, x, loss and right side of E7; `source` holds Q0 and Q1."""
    system: tuple[Tensor, ...] = _System.apply(
        medium.grid,
        medium.absorption.field is medium.remaining.field,
        diffusion,
        medium.absorption.scale,
        medium.absorption.field,
        medium.remaining.scale,
        medium.remaining.field,
        outside,
        source.mean,
        *(source.flux or ()),
    )
    return system


class _System(torch.autograd.Function):
    """Conductances, loss and right side.

    `is_shared`: absorption and scattering have the same field, which gets both derivatives as one.
    """

    @staticmethod
    def forward(grid: Grid, is_shared: bool, *tensors: Tensor) -> tuple[Tensor, ...]:
        kernel, made = functools.partial(system_kernel, len(tensors) > 7), _empty(grid, *tensors)
        colors = len(made["right"])
        launch_rows(kernel, grid, colors, _given(colors, *tensors), made)
        return tuple(made.values())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.grid, ctx.is_shared, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, *bars: Tensor) -> tuple[Tensor | None, ...]:
        diffusion, a_scale, a_field, s_scale, s_field, outside, mean, *flux = ctx.saved_tensors
        needs_a_scale, needs_a_field, needs_s_scale, _, needs_outside = ctx.needs_input_grad[3:8]
        loss_bar, right_bar = bars[3:]
        colors = len(right_bar)
        given = _given(colors, *ctx.saved_tensors)
        scattering = FieldBar(s_scale, s_field, colors, needs_s_scale)
        is_one = ctx.is_shared and not needs_a_scale and not needs_s_scale
        found = empty_bars(colors, diffusion=diffusion, mean=mean, **name_flux(flux))
        given |= {f"{name}_bar": bar for name, bar in zip(_NAMES, bars, strict=True)}
        given["scattering_factor"] = scattering.factor
        given["absorption_factor"] = given["absorption_scale"] * float(is_one)
        kernel = functools.partial(system_adjoint_kernel, bool(flux))
        launch_rows(kernel, ctx.grid, colors, given, found | {"field_bar": scattering.bar})
        a_scale_bar = a_field_bar = outside_bar = None
        if needs_a_scale:
            a_scale_bar = total(a_field * loss_bar, a_scale)
        if needs_a_field and not is_one:
            a_field_bar = sum_colors(a_scale * loss_bar, a_field)
        if needs_outside:
            outside_bar = total(boundary_loss(diffusion, ctx.grid) * right_bar, outside)
        diffusion_bar, *source_bars = (
            sum_colors(bar, like)
            for bar, like in zip(found.values(), (diffusion, mean, *flux), strict=True)
        )
        absorption_bars = a_scale_bar, a_field_bar
        return (
            *(None, None, diffusion_bar, *absorption_bars, *scattering.split()),
            *(outside_bar, *source_bars),
        )

    @staticmethod
    def jvp(ctx: Any, _grid: None, _is_shared: None, *changes: Tensor | None) -> tuple[Tensor, ...]:
        def change(*tensors: Any) -> tuple[Tensor, ...]:
            values, d_values = split(tensors)
            kernel = functools.partial(system_kernel, len(values) > 7)
            made = _empty(ctx.grid, *values)
            colors = len(made["right"])
            given, d_given = _given(colors, *values), dict(zip(_TENSORS, d_values, strict=False))
            launch_row_tangents(kernel, ctx.grid, colors, given, d_given, made)
            return tuple(made.values())

        d_system: tuple[Tensor, ...] = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_system


def _empty(grid: Grid, *tensors: Tensor) -> dict[str, Tensor]:
    """Room for conductances, loss and right side, by their names."""
    diffusion, (nz, ny, nx) = tensors[0], grid.shape
    shapes = (nz - 1, ny, nx), (nz, ny - 1, nx), (nz, ny, nx - 1)
    made = [diffusion.new_empty(len(diffusion), *shape) for shape in (*shapes, grid.shape)]
    made.append(diffusion.new_empty(_colors(*tensors), *grid.shape))
    return dict(zip(_NAMES, made, strict=True))


def _colors(*tensors: Tensor) -> int:
    """How many colors the right side has."""
    diffusion, *_, outside, mean = tensors[:7]
    return max(map(len, (diffusion, outside, mean)))


def _given(
    colors: int,
    diffusion: Tensor,
    absorption_scale: Tensor,
    absorption: Tensor,
    scattering_scale: Tensor,
    scattering: Tensor,
    outside: Tensor,
    mean: Tensor,
    *flux: Tensor,
) -> dict[str, Any]:
    """What both kernels are given, by its names."""
    return {
        "own": len(diffusion),
        "absorption_fields": len(absorption),
        "scattering_fields": len(scattering),
        "sources": len(mean),
        "diffusion": diffusion,
        "absorption_scale": per_color(absorption_scale, colors),
        "absorption": absorption,
        "scattering_scale": per_color(scattering_scale, colors),
        "scattering": scattering,
        "outside": per_color(outside, colors),
        "mean": mean,
        **name_flux(flux),
    }
