"""The light that cells receive of beams, by its moments in angle, by the kernels of `receive.h`."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.launch import launch_later
from ddrecon.kernels.text import TextKernel, cut
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

CHUNK = 256
"""Cells that one item does on a processor; on a GPU it is one."""
MOST_BEAMS = 48
"""So many beams at most are received at once."""
MOST_SUMS = 1 << 25
"""So many numbers are summed at once, where weights vary: on a GPU every cell has its own."""


def receive(
    field: Tensor, scale: Tensor, entered: Tensor, steps: Tensor, weights: Tensor
) -> Tensor:
    """Moments [moments, C, z, y, x] of L beams together: `weights` times tau, averaged over cells.

    `field` [K, z, y, x] and `scale` [C] of the extinction; `entered` [L, K, z, y, x]: the mass up
    to where beams enter cells; `steps` [L] [u]: their paths in these; `weights` [L, moments, C].
    """
    moments: Tensor = _Received.apply(field, scale, entered, steps, weights)
    return moments


class _Received(torch.autograd.Function):
    """What `receive` returns."""

    @staticmethod
    def forward(*tensors: Tensor) -> Tensor:
        if any(one.requires_grad for one in tensors):
            launch_later(receive_kernel("receive_back", 8 * tensors[0].itemsize).kernel, tensors[0])
        return _receive("receive", tensors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        keep(ctx, *inputs)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        # Once: each access may compute them again.
        field, _, entered, _, weights = tensors = ctx.saved_tensors
        _, needs_scale, _, needs_steps, needs_weights = ctx.needs_input_grad
        varies = needs_scale or needs_steps or needs_weights
        lights, moments, colors = weights.shape
        given = _given(tensors) | {"varies": varies, "bars": bar}
        field_bar, entered_bar = field.new_zeros(field.shape), field.new_empty(entered.shape)
        made = {"field_bar": field_bar, "entered_bar": entered_bar}
        items, _ = cut(field[0].numel(), CHUNK, field)
        width = 1 + (1 + moments) * colors
        found = field.new_zeros(lights, width, dtype=torch.float64)
        part = max(1, MOST_SUMS // found.numel()) if varies else items
        for first in range(0, items, part):
            count = min(part, items - first)
            sums = found.new_zeros(count * varies, lights, width)
            kernel = receive_kernel("receive_back", 8 * field.element_size())
            kernel.launch(count, given | {"first_item": first}, made | {"sums": sums})
            found += sums.sum(0)
        if not varies:
            return field_bar, None, entered_bar, None, None
        steps_bar, scale_bar, weights_bar = found.to(field).split([1, colors, moments * colors], 1)
        weights_bar = weights_bar.reshape(weights.shape)
        return field_bar, scale_bar.sum(0), entered_bar, steps_bar[:, 0], weights_bar

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            values, d_values = tensors[:5], tensors[5:]
            pairs = zip(values, d_values, strict=True)
            changes = [torch.zeros_like(one) if d_one is None else d_one for one, d_one in pairs]
            return _receive("tangent", values, changes)

        d_moments: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_moments


_ARRAYS = "field", "scale", "entered", "steps", "weights"
_SIZES = "cells, channels, colors, moments, lights"


def _given(tensors: Sequence[Tensor]) -> dict[str, Any]:
    """What all kernels are given."""
    field, weights, given = tensors[0], tensors[-1], dict(zip(_ARRAYS, tensors, strict=True))
    lights, moments, colors = weights.shape
    sizes = field[0].numel(), len(field), colors, moments, lights
    return given | dict(zip(_SIZES.split(", "), sizes, strict=True))


def _receive(kind: str, tensors: Sequence[Tensor], changes: Sequence[Tensor] = ()) -> Tensor:
    """Moments, or of kind "tangent" their changes."""
    given, (field, *_) = _given(tensors), tensors
    given |= {f"d_{name}": change for name, change in zip(_ARRAYS, changes, strict=False)}
    made = field.new_empty(given["moments"], given["colors"], *field.shape[1:])
    items, _ = cut(field[0].numel(), CHUNK, field)
    receive_kernel(kind, 8 * field.element_size()).launch(items, given, {"made": made})
    return made


@functools.cache
def receive_kernel(kind: str, bits: int) -> TextKernel:
    """The kernel of `receive.h` called "receive", its "tangent", or "receive_back"."""
    arrays, more, made = ", ".join(_ARRAYS), "F *made", "made"
    call = f"receive<F, {MOST_BEAMS}>(item, {arrays}, made)"
    if kind == "tangent":
        pairs = ", ".join(f"Changing<F>{{{one}, d_{one}}}" for one in _ARRAYS)
        call = f"receive<Dual<F>, {MOST_BEAMS}>(item, {pairs}, made)"
        more = ", ".join([more, *(f"*d_{one}" for one in _ARRAYS)])
    elif kind == "receive_back":
        own = "bars, field_bar, entered_bar, sums"
        call = f"receive_back(item, first_item, varies, {arrays}, {own})"
        more = "F *bars, *field_bar, *entered_bar; double *sums"
        made = "field_bar entered_bar sums"
    text = f"const Receiver<F, IS_GPU ? 1 : {CHUNK}> receiver = {{{_SIZES}}};\nreceiver.{call};"
    given = "long cells; int first_item, channels, colors, moments, lights, varies;"
    given += f" F *{', *'.join(_ARRAYS)}; {more}"
    return TextKernel(f"beams_{kind}", bits, text, given, made, "light/fused/receive.h")
