"""E3 towards a camera as one function of tensors, with its backward pass.

Forward mode takes the formulas of `Moments.positive_along` instead.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.kernels.rows import launch_rows
from ddrecon.light.fused.outgoing_kernels import scatter_adjoint_kernel, scatter_kernel
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium
from ddrecon.numerics.autodiff import differentiate_once

_FLUX = "flux_z", "flux_y", "flux_x"


def scatter_fused(medium: Medium, light: Moments, rays: Rays) -> Tensor:
    """`scatter_towards` by fused kernels."""
    kept = 1 - medium.forward_fraction
    radiance: Tensor = _Scatter.apply(
        medium.grid,
        rays.eye is not None,
        -rays.direction[0] if rays.eye is None else rays.eye,
        torch.stack([kept, kept * medium.mean_cosine]),
        light.mean,
        *(light.flux or ()),
    )
    return radiance


class _Scatter(torch.autograd.Function):
    """Radiance `[C, z, y, x]` towards a `point` [3], or without `is_eye` in that direction.

    `factors` [2]: (1 - f) and (1 - f) g'.
    """

    @staticmethod
    def forward(grid: Grid, is_eye: bool, *tensors: Tensor) -> Tensor:
        *_, mean = tensors[:3]
        radiance = mean.new_empty(max(map(len, tensors[2:])), *grid.shape)
        kernel = functools.partial(scatter_kernel, len(tensors) > 3)
        given = _given(is_eye, *tensors)
        launch_rows(kernel, grid, len(radiance), given, {"radiance": radiance})
        return radiance

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.grid, ctx.is_eye, *tensors = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, radiance_bar: Tensor) -> tuple[Tensor | None, ...]:
        _, factors, mean, *flux = ctx.saved_tensors
        needs_point, needs_factors = ctx.needs_input_grad[2:4]
        with_along = bool(flux) and (needs_point or needs_factors)
        names = "mean", *_FLUX[: len(flux)], *(["along"] if with_along else [])
        shape = radiance_bar.shape
        found = {f"{name}_bar": radiance_bar.new_empty(shape) for name in names}
        kernel = functools.partial(scatter_adjoint_kernel, bool(flux), with_along)
        given = _given(ctx.is_eye, *ctx.saved_tensors) | {"radiance_bar": radiance_bar}
        launch_rows(kernel, ctx.grid, len(radiance_bar), given, found)
        along_bar = found.pop("along_bar", None)
        mean_bar, *flux_bars = (
            bar.sum_to_size(like.shape)
            for bar, like in zip(found.values(), (mean, *flux), strict=True)
        )
        point_bar = factors_bar = None
        if needs_factors:
            factors_bar = torch.stack([(mean * mean_bar).sum() / factors[0], 0 * factors[0]])
        if along_bar is not None:
            point_bar, factor_bar = _direction_bars(ctx, along_bar)
            factors_bar = None if factors_bar is None else factors_bar + factor_bar
        return None, None, point_bar, factors_bar, mean_bar, *flux_bars


def _direction_bars(ctx: Any, along_bar: Tensor) -> tuple[Tensor, Tensor]:
    """Cotangents of the point or direction, and of both factors by what L1 has of them."""
    point, factors, _, *flux = ctx.saved_tensors
    with torch.enable_grad():
        leaf = point.detach().requires_grad_()
        eye = leaf if ctx.is_eye else None
        directions = Rays(leaf, -leaf[None], eye).towards_eye(ctx.grid)
        terms = zip(directions, flux, strict=True)
        along = sum((direction * component * along_bar).sum() for direction, component in terms)
    (point_bar,) = torch.autograd.grad(along, leaf)
    return factors[1] * point_bar, torch.stack([torch.zeros_like(along), along]).detach()


def _given(
    is_eye: bool, point: Tensor, factors: Tensor, mean: Tensor, *flux: Tensor
) -> dict[str, Any]:
    """What both kernels are given, by its names."""
    return {
        "is_eye": int(is_eye),
        "mean_colors": len(mean),
        "flux_colors": len(flux[0]) if flux else 1,
        "point": point,
        "factors": factors,
        "mean": mean,
        **(dict(zip(_FLUX, flux, strict=True)) if flux else {}),
    }
