"""Pixels between the rays of a lattice, by fused kernels: one function of the lattice's values."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.launch import thread_count
from ddrecon.kernels.spare import count_shares
from ddrecon.kernels.text import TextKernel, cut, names_of
from ddrecon.march.lattice import interpolate
from ddrecon.numerics.autodiff import differentiate_once, keep

LENGTH = 256
"""Pixels that an item of a launch does on a processor."""
_PIXELS = """
F *values; int channels, rows, columns, length, total, pixels; F *places; long *hit;
"""
_GIVEN = {"interpolate": "F *out", "spread": "F *out_bar, *values_bar"}
_MADE = {"interpolate": "out", "spread": "values_bar"}


@functools.cache
def pixel_kernel(name: str, bits: int) -> TextKernel:
    """The kernel of that function of `Pixels` (`pixels.h`)."""
    text = f"const Pixels<F> them = {{{names_of(_PIXELS)}}};"
    text += f"them.{name}(item, {names_of(_GIVEN[name])});"
    header = "march/fused/pixels.h"
    return TextKernel(name, bits, text, _PIXELS + _GIVEN[name], _MADE[name], header)


def interpolate_pixels(values: Tensor, places: Tensor, hit: Tensor, count: int) -> Tensor:
    """Numbers [K, `count`] of all pixels.

    `values` [K, r, c] of lattice rays are interpolated at `places` [P, 2] to pixels `hit` [P],
    which ascend; others stay 0.
    """
    out: Tensor = _Interpolate.apply(values, places, hit, count)
    return out


class _Interpolate(torch.autograd.Function):
    """Differentiable in both modes with respect to the values; places are those of a camera that
    is not varied.
    """

    @staticmethod
    def forward(values: Tensor, places: Tensor, hit: Tensor, count: int) -> Tensor:
        out = values.new_zeros(len(values), count)
        items, given = _pixels(values, places, hit, count)
        kernel = pixel_kernel("interpolate", torch.finfo(values.dtype).bits)
        kernel.launch(items, given, {"out": out})
        return out

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        keep(ctx, *inputs[:3])
        ctx.count = inputs[3]

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, out_bar: Tensor) -> tuple[Tensor | None, ...]:
        values, places, hit = ctx.saved_tensors
        bits, threads = torch.finfo(values.dtype).bits, thread_count(places)
        threads = count_shares(threads, values.nbytes)
        shares = [values.new_zeros(values.shape) for _ in range(threads)]
        items, given = _pixels(values, places, hit, ctx.count)
        own = [{"values_bar": share} for share in shares]
        pixel_kernel("spread", bits).launch(items, given | {"out_bar": out_bar}, own[0], shares=own)
        return functools.reduce(Tensor.add_, shares), None, None, None

    @staticmethod
    def jvp(ctx: Any, d_values: Tensor, *_: None) -> Tensor:
        values, places, hit = ctx.saved_tensors
        moves = interpolate(values, places) >= 0
        along = torch.where(moves, interpolate(d_values, places), 0)
        d_out = values.new_zeros(len(values), ctx.count)
        return d_out.index_copy(1, hit, along)


def _pixels(values: Tensor, places: Tensor, hit: Tensor, count: int) -> tuple[int, dict[str, Any]]:
    """Items of a launch, and what they are given of `count` pixels, those in `hit` at `places`."""
    items, length = cut(len(places), LENGTH, places)
    names = "channels", "rows", "columns", "length", "total", "pixels"
    sizes = zip(names, (*values.shape, length, len(places), count), strict=True)
    return items, {**dict(sizes), "values": values, "places": places, "hit": hit}
