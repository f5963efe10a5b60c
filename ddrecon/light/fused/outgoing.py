"""E3 towards a camera as one function of tensors, by the kernels of `outgoing.h`."""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.kernels.text import TextKernel
from ddrecon.light.moments import MARGIN, Moments
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly


def scatter_fused(
    grid: Grid, light: Moments, factors: Tensor, rays: Rays, more: Tensor | None
) -> Tensor:
    """`Moments.positive_along` towards the camera of `rays`, of `light` weighted by `factors`.

    `factors`: as of `Moments.weighted`, [L + 1, C or 1, 1, 1, 1].
    """
    flux = light.flux or (None, None, None)
    given = (light.mean, factors[0], *flux, more)
    colors = max(len(one) for one in given if one is not None)
    degree = 0 if light.flux is None else 1
    if light.higher is not None:
        degree = math.isqrt(len(light.higher) + 4) - 1
    radiance: Tensor = _Scatter.apply(
        grid,
        rays.eye is not None,
        -rays.direction[0] if rays.eye is None else rays.eye,
        factors[: degree + 1].reshape(degree + 1, -1).expand(-1, colors),
        light.mean,
        *flux,
        light.higher,
        None if more is None or degree == 0 else more.expand(colors, *grid.shape),
    )
    return radiance


class _Scatter(torch.autograd.Function):
    """Radiance `[C, z, y, x]` towards a `point` [3], or without `is_eye` in that direction.

    `factors` [L + 1, C]: of light's moments, degree by degree. `light`: the mean, the flux along z,
    y and x, what is higher, and radiance besides; None for what there is not.
    """

    @staticmethod
    def forward(
        grid: Grid, is_eye: bool, point: Tensor, factors: Tensor, *light: Tensor | None
    ) -> Tensor:
        radiance = factors.new_empty(factors.shape[1], *grid.shape)
        made = {"radiance": radiance}
        _launch("scatter", grid, is_eye, made, point=point, factors=factors, light=light)
        return radiance

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.grid, ctx.is_eye, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, radiance_bar: Tensor) -> tuple[Tensor | None, ...]:
        point, factors, *light = ctx.saved_tensors
        colors, *shape = radiance_bar.shape
        bars = [
            None if one is None else radiance_bar.new_empty(*one.shape[:-4], colors, *shape)
            for one in light
        ]
        items = colors * ctx.grid.cells // _width(ctx.grid, radiance_bar)
        sums = radiance_bar.new_empty(len(factors) + 3, items)
        _, _, needs_point, needs_factors, *_ = ctx.needs_input_grad
        kind = f"scatter_back<{int(needs_point)}>"
        given = {"point": point, "factors": factors, "light": light, "radiance_bar": radiance_bar}
        _launch(kind, ctx.grid, ctx.is_eye, {"light_bar": bars, "sums": sums}, **given)
        point_bar = factors_bar = None
        if needs_point or needs_factors:
            found = sums.double().view(len(sums), colors, -1).sum(-1).to(factors)
            factors_bar, point_bar = found[:-3], found[-3:].sum(1)
        light_bar = (
            None if bar is None else bar.sum_to_size(one.shape)
            for bar, one in zip(bars, light, strict=True)
        )
        return None, None, point_bar, factors_bar, *light_bar

    @staticmethod
    def jvp(ctx: Any, _grid: None, _is_eye: None, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            values, d_values = tensors[:8], tensors[8:]
            d_point, d_factors, *d_light = (
                torch.zeros_like(one) if d_one is None and one is not None else d_one
                for one, d_one in zip(values, d_values, strict=True)
            )
            point, factors, *light = values
            d_radiance = factors.new_empty(factors.shape[1], *ctx.grid.shape)
            given = {"point": point, "factors": factors, "light": light}
            given |= {"d_point": d_point, "d_factors": d_factors, "d_light": d_light}
            _launch("tangent", ctx.grid, ctx.is_eye, {"radiance": d_radiance}, **given)
            return d_radiance

        d_radiance: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_radiance


def _width(grid: Grid, like: Tensor) -> int:
    """Cells of an item: a row on a processor, and one on a GPU."""
    return 1 if like.is_cuda else grid.shape[2]


def _launch(kind: str, grid: Grid, is_eye: bool, made: dict[str, Any], **given: Any) -> None:
    """Runs `scatter_kernel` of that `kind` on all cells and colors."""
    factors, (mean, flux, _, _, higher, more) = given["factors"], given["light"]
    (degrees, colors), width = factors.shape, _width(grid, mean)
    own = {
        "width": width,
        "is_eye": is_eye,
        "colors": colors,
        "mean_colors": len(mean),
        "flux_colors": 1 if flux is None else len(flux),
        "higher_colors": 1 if higher is None else higher.shape[1],
        "margin": MARGIN,
        "least": 1e6 * torch.finfo(mean.dtype).tiny,
    }
    for corner, values in zip("nhl", (grid.shape, grid.spacing, grid.lower), strict=True):
        own |= {f"{corner}{axis}": value for axis, value in zip("zyx", values, strict=True)}
    kernel = scatter_kernel(kind, degrees - 1, more is not None, 8 * mean.element_size())
    kernel.launch(colors * grid.cells // width, own | given, made)


_INTEGERS = "nz, ny, nx, width, is_eye, colors, mean_colors, flux_colors, higher_colors"
_REALS = "hz, hy, hx, lz, ly, lx, margin, least"


@functools.cache
def scatter_kernel(kind: str, degree: int, has_more: bool, bits: int) -> TextKernel:
    """The kernel "scatter", its "tangent", or "scatter_back", of light known to `degree`.

    The last with "<1>" where the point varies, else "<0>". With `has_more` there is radiance
    besides.
    """
    if kind == "scatter":
        light = "[&](int k) HERE { return light[k]; }"
        call = f"scatter<F>(item, point, factors, {light}, radiance)"
        more, made = "*radiance", "radiance"
    elif kind == "tangent":
        light = "[&](int k) HERE { return Changing<F>{light[k], d_light[k]}; }"
        point, factors = (f"Changing<F>{{{name}, d_{name}}}" for name in ("point", "factors"))
        call = f"scatter<Dual<F>>(item, {point}, {factors}, {light}, radiance)"
        more, made = "*d_point, *d_factors, *d_light[6], *radiance", "radiance"
    else:
        call = f"{kind}(item, point, factors, light, radiance_bar, light_bar, sums)"
        more, made = "*radiance_bar, *light_bar[6], *sums", "light_bar sums"
    text = f"Outgoing<F, {degree}, {int(has_more)}>{{{_INTEGERS}, {_REALS}}}.{call};"
    given = f"int {_INTEGERS}; F {_REALS}, *point, *factors, *light[6], {more}"
    name = f"{kind.split('<')[0]}_towards"
    return TextKernel(name, bits, text, given, made, "light/fused/outgoing.h")
