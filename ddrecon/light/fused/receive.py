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
        if any(tensor.requires_grad for tensor in tensors):
            launch_later(receive_kernel("receive_back", 8 * tensors[0].itemsize).kernel, tensors[0])
        return _receive("receive", _arguments(tensors))

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
        arguments = _arguments(tensors) | {"varies": varies, "bars": bar}
        field_bar, entered_bar = field.new_zeros(field.shape), field.new_empty(entered.shape)
        bars = {"field_bar": field_bar, "entered_bar": entered_bar}
        items, _ = cut(field[0].numel(), CHUNK, field)
        width = 1 + (1 + moments) * colors
        total = field.new_zeros(lights, width, dtype=torch.float64)
        most = max(1, MOST_SUMS // total.numel()) if varies else items
        kernel = receive_kernel("receive_back", 8 * field.element_size())
        for first in range(0, items, most):
            count = min(most, items - first)
            sums = total.new_zeros(count * varies, lights, width)
            kernel.launch(count, arguments | {"first_item": first}, bars | {"sums": sums})
            total += sums.sum(0)
        if not varies:
            return field_bar, None, entered_bar, None, None
        steps_bar, scale_bar, weights_bar = total.to(field).split([1, colors, moments * colors], 1)
        weights_bar = weights_bar.reshape(weights.shape)
        return field_bar, scale_bar.sum(0), entered_bar, steps_bar[:, 0], weights_bar

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            values, d_values = tensors[:5], tensors[5:]
            arguments = _arguments(values)
            for name, value, d_value in zip(_ARRAYS, values, d_values, strict=True):
                arguments[f"d_{name}"] = torch.zeros_like(value) if d_value is None else d_value
            return _receive("tangent", arguments)

        d_moments: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_moments


_ARRAYS = "field", "scale", "entered", "steps", "weights"
_SIZES = "cells, channels, colors, moments, lights"


def _arguments(tensors: Sequence[Tensor]) -> dict[str, Any]:
    """What all kernels are given: arrays and their sizes, by name."""
    field, weights = tensors[0], tensors[-1]
    lights, moments, colors = weights.shape
    sizes = field[0].numel(), len(field), colors, moments, lights
    names = *_ARRAYS, *_SIZES.split(", ")
    return dict(zip(names, (*tensors, *sizes), strict=True))


def _receive(kind: str, arguments: dict[str, Any]) -> Tensor:
    """Moments, or of kind "tangent" their changes."""
    field: Tensor = arguments["field"]
    phi = field.new_empty(arguments["moments"], arguments["colors"], *field.shape[1:])
    items, _ = cut(field[0].numel(), CHUNK, field)
    receive_kernel(kind, 8 * field.element_size()).launch(items, arguments, {"phi": phi})
    return phi


@functools.cache
def receive_kernel(kind: str, bits: int) -> TextKernel:
    """The kernel of `receive.h` called "receive", its "tangent", or "receive_back"."""
    arrays, more, written = ", ".join(_ARRAYS), "F *phi", "phi"
    call = f"receive<F, {MOST_BEAMS}>(item, {arrays}, phi)"
    if kind == "tangent":
        pairs = ", ".join(f"Changing<F>{{{name}, d_{name}}}" for name in _ARRAYS)
        call = f"receive<Dual<F>, {MOST_BEAMS}>(item, {pairs}, phi)"
        more = ", ".join([more, *(f"*d_{name}" for name in _ARRAYS)])
    elif kind == "receive_back":
        bars = "bars, field_bar, entered_bar, sums"
        call = f"receive_back(item, first_item, varies, {arrays}, {bars})"
        more = "F *bars, *field_bar, *entered_bar; double *sums"
        written = "field_bar entered_bar sums"
    text = f"const Receiver<F, IS_GPU ? 1 : {CHUNK}> receiver = {{{_SIZES}}};\nreceiver.{call};"
    declared = "long cells; int first_item, channels, colors, moments, lights, varies;"
    declared += f" F *{', *'.join(_ARRAYS)}; {more}"
    return TextKernel(f"beams_{kind}", bits, text, declared, written, "light/fused/receive.h")
