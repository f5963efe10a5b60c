"""The light that cells receive of beams, by its moments in angle, by the kernels of `receive.h`."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.text import TextKernel, cut

CHUNK = 512
"""Cells that one item does on a processor; on a GPU it is one."""

MOST_BEAMS = 16
"""So many beams at most are received at once."""
MOST_SUMS = 1 << 25
"""So many numbers are summed at once, where weights vary: on a GPU every cell has its own."""

_SHARED = "cells, channels, colors, moments, light, lights, numbers"
_ARRAYS = "scale", "weights", "field", "entered"
_GIVEN = """
long cells; int first_item, channels, colors, moments, light, lights, adds, varies, has_bar;
F *numbers, *scale, *weights, *field, *entered
"""
"""`has_bar` says which moments have cotangents, a bit each, of which the last is for `higher`."""


@functools.cache
def receive_kernel(kind: str, bits: int) -> TextKernel:
    """The kernel of `receive.h` called "receive", its "tangent", or "receive_back"."""
    arrays, more, made = ", ".join(_ARRAYS), "F *made[5]", "made"
    call = f"receive<F, {MOST_BEAMS}>(item, adds, {arrays}, made)"
    if kind == "tangent":
        pairs = ", ".join(f"Changing<F>{{{one}, d_{one}}}" for one in _ARRAYS)
        call = f"receive<Dual<F>, {MOST_BEAMS}>(item, adds, {pairs}, made)"
        more = ", ".join([more, *(f"*d_{one}" for one in _ARRAYS)])
    elif kind == "receive_back":
        own = "bars, entered_bar, field_bar, sums"
        call = f"receive_back(item, first_item, varies, has_bar, {arrays}, {own})"
        more = "F *bars[5], *entered_bar, *field_bar; double *sums"
        made = "entered_bar field_bar sums"
    text = f"const Receiver<F, IS_GPU ? 1 : {CHUNK}> receiver = {{{_SHARED}}};\nreceiver.{call};"
    given = f"{_GIVEN}; {more}"
    return TextKernel(f"beams_{kind}", bits, text, given, made, "light/fused/receive.h")


class Receiver:
    """What cells receive of L beams: the same for all of them, as kernels read it.

    `field` [K, z, y, x], `scale` [C], `numbers` [L, 4] and `weights` [L, moments, C].
    """

    def __init__(self, field: Tensor, scale: Tensor, numbers: Tensor, weights: Tensor):
        self.field, self.colors, self.moments = field, weights.shape[2], weights.shape[1]
        self.bits, cells = field.element_size() * 8, field[0].numel()
        self.items, _ = cut(cells, CHUNK, field)
        self.given: dict[str, Any] = {
            "cells": cells,
            "channels": len(field),
            "colors": self.colors,
            "moments": self.moments,
            "numbers": numbers,
            "scale": scale.contiguous(),
            "weights": weights.contiguous(),
            "field": field.contiguous(),
        }

    def new_moments(self) -> list[Tensor]:
        """Uninitialized moments of all colors: the mean, three of the flux, and all others."""
        shape = self.colors, *self.field.shape[1:]
        found = [self.field.new_empty(shape) for _ in range(min(self.moments, 4))]
        if self.moments > 4:
            found.append(self.field.new_empty(self.moments - 4, *shape))
        return found

    def receive(
        self, light: int, entered: Tensor, moments: Sequence[Tensor], **d_given: Tensor | None
    ) -> None:
        """Writes what is received of beams from number `light` on to `moments`; adds of the others.

        `entered` [n, K, z, y, x]: the mass that n of them pass up to where they enter each cell.
        With changes `d_given` of that, and of the field, scale and weights, it is the change.
        """
        given = self.given | {
            "light": light,
            "lights": len(entered),
            "adds": light > 0,
            "entered": entered,
        }
        for name, change in d_given.items():
            given[name] = torch.zeros_like(given[name[2:]]) if change is None else change
        kernel = receive_kernel("tangent" if d_given else "receive", self.bits)
        kernel.launch(self.items, given, {"made": _five(moments)})

    def adjoint(
        self,
        light: int,
        entered: Tensor,
        bars: Sequence[Tensor | None],
        field_bar: Tensor,
        varies: bool,
    ) -> tuple[Tensor, Tensor | None]:
        """The cotangent of `entered`, and if it `varies` those [n, ...] of step, scale and weights.

        Arguments as of `receive`; `bars`: of the moments, None for zero. Adds to the cotangent of
        the field.
        """
        lights, entered_bar = len(entered), torch.zeros_like(entered)
        own = {"light": light, "lights": lights, "varies": varies, "entered": entered}
        own["has_bar"] = sum(1 << a for a, bar in enumerate(bars) if bar is not None)
        given = self.given | own | {"bars": _five(bars)}
        made = {"entered_bar": entered_bar, "field_bar": field_bar}
        width = 1 + (1 + self.moments) * self.colors
        part = max(1, MOST_SUMS // (lights * width)) if varies else self.items
        found = entered.new_zeros(lights, width, dtype=torch.float64)
        if not own["has_bar"]:
            return entered_bar, found
        for first in range(0, self.items, part):
            items = min(part, self.items - first)
            sums = found.new_zeros(items * varies, lights, width)
            given["first_item"] = first
            receive_kernel("receive_back", self.bits).launch(items, given, made | {"sums": sums})
            found += sums.sum(0)
        return entered_bar, found if varies else None


def _five(moments: Sequence[Tensor | None]) -> list[Tensor | None]:
    """`moments` as kernels have them, None for those that are missing."""
    return [*moments, *[None] * (5 - len(moments))]
