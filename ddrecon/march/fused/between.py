"""Pixels between the rays of a lattice, by fused kernels: one function of the lattice's values."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.launch import thread_count
from ddrecon.kernels.shares import count_shares
from ddrecon.kernels.text import TextKernel, cut
from ddrecon.march.fused.kernels import names_of
from ddrecon.march.lattice import DOUBT, find_uneven, interpolate
from ddrecon.numerics.autodiff import differentiate_once, keep

LENGTH = 256
"""Pixels that an item of a launch does on a processor."""
FEW = 1 << 14
"""So many numbers of pixels are not worth a second thread."""


_HEADER = "march/fused/pixels.h"
_PIXELS = """
F *values; int channels, rows, columns, length, total, pixels; F *places; long *hit;
"""
_RECORD = f"const Pixels<F> them = {{{names_of(_PIXELS)}}};"


@functools.cache
def interpolation_kernel(bits: int) -> TextKernel:
    """The kernel of values of `Pixels`, and of which are rough."""
    text, given = (
        "them.interpolate(item, uneven, bound, out, rough);",
        "F *uneven, *bound, *out; int *rough",
    )
    return TextKernel("interpolate", bits, _RECORD + text, _PIXELS + given, "out rough", _HEADER)


@functools.cache
def spread_kernel(bits: int) -> TextKernel:
    """The kernel of what cotangents of `Pixels` are for the lattice's values."""
    text, given = "them.spread(item, out_bar, values_bar);", "F *out_bar, *values_bar"
    return TextKernel("spread", bits, _RECORD + text, _PIXELS + given, "values_bar", _HEADER)


def interpolate_pixels(
    values: Tensor, places: Tensor, hit: Tensor, count: int, behind: Tensor, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Radiance and opacity [2 C, `count`] of all pixels, and the numbers [*] of the rough ones.

    `values` [2 C, r, c] of lattice rays are interpolated at `places` [P, 2] to pixels `hit` [P],
    which ascend; others stay 0. Rough are those of `hit` that `lattice.is_rough` names for
    `tolerance` of what is seen, with light `behind` [1]. They come in an order in which neighbors
    are neighbors in the volume.
    """
    out, order = _Interpolate.apply(values, places, hit, count, behind, tolerance)
    rough = order.nonzero()[:, 0]
    return out, rough[order[rough].argsort(stable=True)]


class _Interpolate(torch.autograd.Function):
    """Differentiable in both modes with respect to the values; places are those of a camera that
    is not varied.
    """

    @staticmethod
    def forward(
        values: Tensor, places: Tensor, hit: Tensor, count: int, behind: Tensor, tolerance: float
    ) -> tuple[Tensor, Tensor]:
        bits, channels = torch.finfo(values.dtype).bits, len(values)
        scattered, opacity = values.chunk(2)
        brightness = (scattered + behind * (1 - opacity)).square().mean(dtype=torch.float64).sqrt()
        bound = (tolerance / DOUBT * brightness).to(values.dtype).view(1)
        uneven = find_uneven(torch.cat([scattered, behind * opacity]))
        out = values.new_zeros(channels, count)
        rough = hit.new_empty(hit.shape, dtype=torch.int32)
        items, given = _pixels(values, places, hit, count)
        given |= {"uneven": uneven, "bound": bound}
        made = {"out": out, "rough": rough}
        interpolation_kernel(bits).launch(items, given, made, _threads(places, channels))
        return out, rough

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.mark_non_differentiable(output[1])
        keep(ctx, *inputs[:3])
        ctx.count = inputs[3]

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, out_bar: Tensor, _: None) -> tuple[Tensor | None, ...]:
        values, places, hit = ctx.saved_tensors
        bits, threads = torch.finfo(values.dtype).bits, _threads(places, len(values))
        threads = count_shares(threads, values.nbytes)
        shares = [values.new_zeros(values.shape) for _ in range(threads)]
        items, given = _pixels(values, places, hit, ctx.count)
        own = [{"values_bar": share} for share in shares]
        spread_kernel(bits).launch(items, given | {"out_bar": out_bar}, own[0], shares=own)
        return functools.reduce(Tensor.add_, shares), None, None, None, None, None

    @staticmethod
    def jvp(ctx: Any, d_values: Tensor, *_: None) -> tuple[Tensor, None]:
        values, places, hit = ctx.saved_tensors
        moves = interpolate(values, places) >= 0
        along = torch.where(moves, interpolate(d_values, places), 0)
        d_out = values.new_zeros(len(values), ctx.count)
        return d_out.index_copy(1, hit, along), None


def _threads(pixels: Tensor, channels: int = 1) -> int:
    return 1 if pixels.numel() * channels < FEW else thread_count(pixels)


def _pixels(values: Tensor, places: Tensor, hit: Tensor, count: int) -> tuple[int, dict[str, Any]]:
    """Items of a launch, and what they are given of `count` pixels, those in `hit` at `places`."""
    items, length = cut(len(places), LENGTH, places)
    names = "channels", "rows", "columns", "length", "total", "pixels"
    sizes = zip(names, (*values.shape, length, len(places), count), strict=True)
    return items, {**dict(sizes), "values": values, "places": places, "hit": hit}
