"""E3 towards a camera as one function of tensors, with its derivatives."""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.kernels.dual import launch_row_tangents, split
from ddrecon.kernels.rows import launch_rows
from ddrecon.light.fused.outgoing_kernels import scatter_adjoint_kernel, scatter_kernel
from ddrecon.light.moments import Moments, Vector
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_FLUX = "flux_z", "flux_y", "flux_x"
_TENSORS = "point", "factors", "more", "mean", "higher", *_FLUX


def scatter_fused(
    grid: Grid, light: Moments, factors: Tensor, rays: Rays, more: Tensor | None
) -> Tensor:
    """`Moments.positive_along` towards the camera of `rays`, of `light` weighted by `factors`.

    `factors`: as of `Moments.weighted`, [L + 1, C or 1, 1, 1, 1].
    """
    flux = light.flux or ()
    colors = max(map(len, (light.mean, factors[0], *flux, *([] if more is None else [more]))))
    degree = 0 if light.flux is None else 1
    if light.higher is not None:
        degree = math.isqrt(len(light.higher) + 4) - 1
    by_color = factors[: degree + 1].reshape(degree + 1, -1).expand(-1, colors)
    radiance: Tensor = _Scatter.apply(
        grid,
        rays.eye is not None,
        -rays.direction[0] if rays.eye is None else rays.eye,
        by_color,
        more if light.flux is None or more is None else more.expand(colors, *grid.shape),
        light.mean,
        light.higher,
        *flux,
    )
    return radiance


class _Scatter(torch.autograd.Function):
    """Radiance `[C, z, y, x]` towards a `point` [3], or without `is_eye` in that direction.

    `factors` [L + 1, C]: of light's moments, degree by degree.
    """

    @staticmethod
    def forward(grid: Grid, is_eye: bool, *tensors: Any) -> Tensor:
        given, is_so = _given(is_eye, *tensors)
        radiance = given["mean"].new_empty(given["colors"], *grid.shape)
        kernel = functools.partial(scatter_kernel, *is_so)
        launch_rows(kernel, grid, len(radiance), given, {"radiance": radiance})
        return radiance

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.grid, ctx.is_eye, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, radiance_bar: Tensor) -> tuple[Tensor | None, ...]:
        _, factors, _, mean, higher, *flux = ctx.saved_tensors
        given, (degree, has_more) = _given(ctx.is_eye, *ctx.saved_tensors)
        _, _, needs_point, needs_factors, needs_more, *_ = ctx.needs_input_grad
        with_along = degree > 0 and (needs_point or needs_more)
        names = "mean", *_FLUX[: len(flux)], *(["along"] if with_along else [])
        shape = radiance_bar.shape
        found = {f"{name}_bar": radiance_bar.new_empty(shape) for name in names}
        if higher is not None:
            found["higher_bar"] = radiance_bar.new_empty(len(higher), *shape)
        items = len(radiance_bar) * (ctx.grid.cells if mean.is_cuda else math.prod(shape[1:3]))
        found["sums"] = radiance_bar.new_empty(max(degree, 1) + 1, items)
        kernel = functools.partial(scatter_adjoint_kernel, degree, has_more, with_along)
        given["radiance_bar"] = radiance_bar
        launch_rows(kernel, ctx.grid, len(radiance_bar), given, found)
        along_bar = found.get("along_bar")
        factors_bar = point_bar = None
        if needs_factors:
            sums = found["sums"].double().view(-1, len(radiance_bar), items // len(radiance_bar))
            factors_bar = sums.sum(-1)[: len(factors)].to(factors)
        if needs_point and along_bar is not None:
            point_bar = _point_bar(ctx, along_bar)
        return (
            None,
            None,
            point_bar,
            factors_bar,
            along_bar if needs_more else None,
            found["mean_bar"].sum_to_size(mean.shape),
            None if higher is None else found["higher_bar"].sum_to_size(higher.shape),
            *(
                found[f"{name}_bar"].sum_to_size(one.shape)
                for name, one in zip(_FLUX, flux, strict=False)
            ),
        )

    @staticmethod
    def jvp(ctx: Any, _grid: None, _is_eye: None, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            values, d_values = split(tensors)
            given, is_so = _given(ctx.is_eye, *values)
            d_given = dict(zip(_TENSORS, d_values, strict=False))
            d_radiance = given["mean"].new_empty(given["colors"], *ctx.grid.shape)
            kernel = functools.partial(scatter_kernel, *is_so)
            made = {"radiance": d_radiance}
            launch_row_tangents(kernel, ctx.grid, len(d_radiance), given, d_given, made)
            return d_radiance

        d_radiance: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_radiance


def _point_bar(ctx: Any, along_bar: Tensor) -> Tensor:
    """The cotangent of the point or direction, by what depends on it."""
    point, factors, _, mean, higher, *flux = ctx.saved_tensors
    vector: Vector = (flux[0], flux[1], flux[2])
    light = Moments(torch.zeros_like(mean), vector, higher)
    with torch.enable_grad():
        leaf = point.detach().requires_grad_()
        eye = leaf if ctx.is_eye else None
        directions = Rays(leaf, -leaf[None], eye).towards_eye(ctx.grid)
        weighted = light.weighted(factors[..., None, None, None])
        along = (weighted.along(directions) * along_bar).sum()
    (point_bar,) = torch.autograd.grad(along, leaf)
    return point_bar


def _given(
    is_eye: bool,
    point: Tensor,
    factors: Tensor,
    more: Tensor | None,
    mean: Tensor,
    higher: Tensor | None,
    *flux: Tensor,
) -> tuple[dict[str, Any], tuple[int, bool]]:
    """What both kernels are given, by its names; light's degree, and whether there is `more`."""
    degree = len(factors) - 1
    given = {
        "is_eye": int(is_eye),
        "colors": factors.shape[1],
        "mean_colors": len(mean),
        "flux_colors": len(flux[0]) if flux else 1,
        "higher_colors": 1 if higher is None else higher.shape[1],
        "point": point,
        "factors": factors,
        "mean": mean,
        **dict(zip(_FLUX, flux, strict=False)),
    }
    if higher is not None:
        given["higher"] = higher
    if more is not None:
        given["more"] = more
    return given, (degree, more is not None and degree > 0)
