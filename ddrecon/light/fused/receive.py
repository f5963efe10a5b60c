"""The light that cells receive of beams, by its moments in angle, by the kernels of `receive.h`."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.launch import launch_later
from ddrecon.kernels.text import TextKernel, cut
from ddrecon.light.beam import MOST_BEAMS
from ddrecon.numerics.autodiff import differentiate_once, fill_changes, keep, run_plainly

CHUNK = 256
"""Cells that one item does on a processor; on a GPU it is one."""
MOST_SUMS = 1 << 25
"""So many numbers are summed at once, where weights vary: on a GPU every cell has its own."""


def receive(
    field: Tensor, scale: Tensor, entered: Tensor, steps: Tensor, weights: Tensor
) -> Tensor:
    """Moments [moments, C, z, y, x] of L beams together: `weights` times tau, averaged over cells.

    `field` [K, z, y, x] and `scale` [C or 1, 1, 1, 1] of the extinction; `entered` [L, K, z, y, x]:
    the mass up to where beams enter cells; `steps` [L] [u]: their paths in these; `weights`
    [L, moments, C or 1].
    """
    colors = max(weights.shape[2], len(scale))
    weights, scales = weights.expand(-1, -1, colors), scale.view(-1).expand(len(steps), 1, colors)
    numbers = torch.cat([scales, scales * steps[:, None, None], weights], 1)
    phi: Tensor = _Received.apply(field, entered, numbers)
    return phi


class _Received(torch.autograd.Function):
    """The moments, by `numbers` [L, 2 + moments, C]: scale, scale times step, and weights."""

    @staticmethod
    def forward(field: Tensor, entered: Tensor, numbers: Tensor) -> Tensor:
        if field.requires_grad or entered.requires_grad or numbers.requires_grad:
            launch_later(receive_kernel("receive_back", 8 * field.itemsize).kernel, field)
        return _receive("receive", field, entered, numbers)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        keep(ctx, *inputs)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        field, entered, numbers = ctx.saved_tensors
        vary = ctx.needs_input_grad[2]
        arguments = _arguments(field, entered, numbers) | {"vary": vary, "bars": bar}
        field_bar, entered_bar = field.new_zeros(field.shape), field.new_empty(entered.shape)
        numbers_bar = torch.zeros_like(numbers, dtype=torch.float64)

        # Sums of as many items at a time as memory has room for.
        items, _ = cut(field[0].numel(), CHUNK, field)
        most = max(1, MOST_SUMS // numbers.numel()) if vary else items
        kernel = receive_kernel("receive_back", 8 * field.itemsize)
        for first in range(0, items, most):
            count = min(most, items - first)
            sums = numbers_bar.new_zeros(count * vary, *numbers.shape)
            bars = {"field_bar": field_bar, "entered_bar": entered_bar, "sums": sums}
            kernel.launch(count, arguments | {"first_item": first}, bars)
            numbers_bar += sums.sum(0)
        return field_bar, entered_bar, numbers_bar.to(numbers)

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            d_field, d_entered, d_numbers = fill_changes(tensors[3:], tensors[:3])
            d_values = {"d_field": d_field, "d_entered": d_entered, "d_numbers": d_numbers}
            return _receive("tangent", *tensors[:3], **d_values)

        d_phi: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_phi


_SIZES = "cells, channels, colors, moments, lights"


def _arguments(field: Tensor, entered: Tensor, numbers: Tensor) -> dict[str, Any]:
    """What all kernels read: arrays and their sizes, by name."""
    lights, rows, colors = numbers.shape
    sizes = field[0].numel(), len(field), colors, rows - 2, lights
    arrays = {"field": field, "entered": entered, "numbers": numbers}
    return arrays | dict(zip(_SIZES.split(", "), sizes, strict=True))


def _receive(
    kind: str, field: Tensor, entered: Tensor, numbers: Tensor, **changes: Tensor
) -> Tensor:
    """Moments, or of kind "tangent" their changes."""
    arguments = _arguments(field, entered, numbers) | changes
    phi = field.new_empty(arguments["moments"], arguments["colors"], *field.shape[1:])
    items, _ = cut(field[0].numel(), CHUNK, field)
    receive_kernel(kind, 8 * field.itemsize).launch(items, arguments, {"phi": phi})
    return phi


@functools.cache
def receive_kernel(kind: str, bits: int) -> TextKernel:
    """The kernel of `receive.h` called "receive", its "tangent", or "receive_back"."""
    call, arrays = {
        "receive": (f"receive<F, {MOST_BEAMS}>(item, field, entered, numbers, phi)", "F *phi"),
        "tangent": (
            f"receive<Dual<F>, {MOST_BEAMS}>(item, Changing<F>{{field, d_field}}, "
            "Changing<F>{entered, d_entered}, Changing<F>{numbers, d_numbers}, phi)",
            "F *phi, *d_field, *d_entered, *d_numbers",
        ),
        "receive_back": (
            "receive_back(item, first_item, vary, field, entered, numbers, bars, field_bar, "
            "entered_bar, sums)",
            "F *bars, *field_bar, *entered_bar; double *sums; int first_item; bool vary",
        ),
    }[kind]
    text = f"const Receiver<F, IS_GPU ? 1 : {CHUNK}> receiver = {{{_SIZES}}};\nreceiver.{call};"
    declared = "long cells; int channels, colors, moments, lights; F *field, *entered, *numbers; "
    written = "field_bar entered_bar sums" if kind == "receive_back" else "phi"
    header = "light/fused/receive.h"
    return TextKernel(f"beams_{kind}", bits, text, declared + arrays, written, header)
