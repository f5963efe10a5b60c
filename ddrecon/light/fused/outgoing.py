"""E3 towards a camera as one function of tensors, by the kernels of `outgoing.h`."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Rays
from ddrecon.grid import Grid
from ddrecon.kernels.text import TextKernel
from ddrecon.light.moments import MARGIN, Moments
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_LIGHT = "mean", "flux_z", "flux_y", "flux_x", "higher", "more"
_TENSORS = "point", "factors", *_LIGHT


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

    `factors` [L + 1, C]: of light's moments, degree by degree.
    """

    @staticmethod
    def forward(grid: Grid, is_eye: bool, *tensors: Tensor | None) -> Tensor:
        return _scatter("scatter", grid, is_eye, _named(tensors))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.grid, ctx.is_eye, *tensors = inputs
        keep(ctx, *tensors)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, radiance_bar: Tensor) -> tuple[Tensor | None, ...]:
        named = _named(ctx.saved_tensors)
        factors, (colors, *shape) = named["factors"], radiance_bar.shape
        bars = {
            name: radiance_bar.new_empty(*one.shape[:-4], colors, *shape)
            for name, one in named.items()
            if name in _LIGHT
        }
        # Of the factors, then of the point.
        items = colors * _items(ctx.grid, radiance_bar)
        sums = radiance_bar.new_empty(len(factors) + 3, items)
        kind = "scatter_back<1>" if ctx.needs_input_grad[2] else "scatter_back<0>"
        made = {f"{name}_bar": bar for name, bar in bars.items()} | {"sums": sums}
        given = {"items": items, "radiance_bar": radiance_bar}
        kernel, own = _prepare(kind, ctx.grid, ctx.is_eye, named)
        kernel.launch(items, own | given, made)
        found = sums.double().view(len(sums), colors, -1).sum(-1).to(factors)
        named_bars = {name: bar.sum_to_size(named[name].shape) for name, bar in bars.items()}
        named_bars |= {"factors": found[:-3], "point": found[-3:].sum(1)}
        return None, None, *map(named_bars.get, _TENSORS)

    @staticmethod
    def jvp(ctx: Any, _grid: None, _is_eye: None, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Tensor | None) -> Tensor:
            half = len(tensors) // 2
            values, found = _named(tensors[:half]), _named(tensors[half:])
            d_given = {
                f"d_{name}": found.get(name, torch.zeros_like(one)) for name, one in values.items()
            }
            return _scatter("tangent", ctx.grid, ctx.is_eye, values, **d_given)

        d_radiance: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_radiance


def _named(tensors: Sequence[Tensor | None]) -> dict[str, Tensor]:
    """Those `tensors` that there are, by their names."""
    return {name: one for name, one in zip(_TENSORS, tensors, strict=True) if one is not None}


def _scatter(
    kind: str, grid: Grid, is_eye: bool, named: dict[str, Tensor], **given: Tensor
) -> Tensor:
    """The radiance, or its change."""
    radiance = named["mean"].new_empty(named["factors"].shape[1], *grid.shape)
    kernel, own = _prepare(kind, grid, is_eye, named)
    kernel.launch(len(radiance) * _items(grid, radiance), own | given, {"radiance": radiance})
    return radiance


def _items(grid: Grid, like: Tensor) -> int:
    """Items of a color: rows on a processor, and cells on a GPU."""
    return grid.cells if like.is_cuda else grid.cells // grid.shape[2]


def _prepare(
    kind: str, grid: Grid, is_eye: bool, named: dict[str, Tensor]
) -> tuple[TextKernel, dict[str, Any]]:
    """The kernel for such light, and what it is given."""
    mean, factors, flux, higher = (
        named.get(name) for name in ("mean", "factors", "flux_z", "higher")
    )
    numbers = {
        "width": 1 if mean.is_cuda else grid.shape[2],
        "is_eye": is_eye,
        "colors": factors.shape[1],
        "mean_colors": len(mean),
        "flux_colors": 1 if flux is None else len(flux),
        "higher_colors": 1 if higher is None else higher.shape[1],
        "margin": MARGIN,
        "least": 1e6 * torch.finfo(mean.dtype).tiny,
    }
    for corner, values in zip(("n", "h", "l"), (grid.shape, grid.spacing, grid.lower), strict=True):
        numbers |= {f"{corner}{axis}": value for axis, value in zip("zyx", values, strict=True)}
    kernel = scatter_kernel(kind, len(factors) - 1, "more" in named, 8 * mean.element_size())
    return kernel, numbers | named


_NUMBERS = (
    "nz, ny, nx, width, is_eye, colors, mean_colors, flux_colors, higher_colors",
    "hz, hy, hx, lz, ly, lx, margin, least",
)


@functools.cache
def scatter_kernel(kind: str, degree: int, has_more: bool, bits: int) -> TextKernel:
    """The kernel "scatter", its "tangent", or "scatter_back", of light known to `degree`.

    The last is "<1>" where the point varies. With `has_more` there is radiance besides.
    """
    light, bars = ", ".join(_LIGHT), [f"{name}_bar" for name in _LIGHT]
    given, made = ", ".join(f"*{name}" for name in _TENSORS), "radiance"
    if kind == "scatter":
        call, more = (
            f"scatter<F>(item, point, factors, Own::Light<const F*>{{{light}}}, radiance)",
            "*radiance",
        )
    elif kind == "tangent":
        pairs = [f"Changing<F>{{{name}, d_{name}}}" for name in _TENSORS]
        call = f"scatter<Dual<F>>(item, {pairs[0]}, {pairs[1]}, Own::Light<Changing<F>>{{{', '.join(pairs[2:])}}}, radiance)"
        more = ", ".join(["*radiance", *(f"*d_{name}" for name in _TENSORS)])
    else:
        call = f"{kind}(item, items, point, factors, {{{light}}}, radiance_bar, {{{', '.join(bars)}}}, sums)"
        more = ", ".join(["*radiance_bar", "*sums", *(f"*{name}" for name in bars)])
        made = " ".join(["sums", *bars])
    text = f"""
        typedef Outgoing<F, {degree}, {int(has_more)}> Own;
        const Own own = {{{", ".join(_NUMBERS)}}};
        own.{call};
    """
    given = f"int {_NUMBERS[0]}, items; F {_NUMBERS[1]}, {given}, {more}"
    return TextKernel(
        kind.split("<")[0] + "_towards", bits, text, given, made, "light/fused/outgoing.h"
    )
