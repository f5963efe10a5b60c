"""Fields of coefficients with empty cells around them, and where their rows are not empty."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.diffusion.rounds.fused.records import struct_kernel
from ddrecon.kernels.text import TextKernel

MARGIN = 16
"""Cells before an array of rows, which begin where vectors do."""


def surround(fields: Sequence[Tensor], pitch: int) -> tuple[list[Tensor], Tensor, Tensor]:
    """`fields` [K, z, y, x] with empty cells around them; `ranges` and `densest` of their rows.

    They are flat: MARGIN zeros and [K, z + 2, y + 2, pitch]. `ranges` [z, y, 4]: from and to where
    steps to the cells of a row meet a medium, and where those meet one that begin at these cells.
    They begin where vectors do; empty ones are from 0 to 0. `densest` [z, y]: the largest value of
    the first field that steps to these cells meet.
    """
    _, depth, height, width = fields[0].shape
    rows, channels = (depth + 2) * (height + 2), [len(field) for field in fields]
    sizes = [MARGIN + each * rows * pitch for each in channels]
    larger = fields[0].new_empty(sum(sizes))
    tops, densest = larger.new_empty(rows), larger.new_empty(depth * height)
    occupied, ranges = (
        larger.new_empty(count, dtype=torch.int32) for count in (2 * rows, 4 * len(densest))
    )
    given = {
        "extinction": fields[0].detach(), "extinction_channels": channels[0],
        "scattering": fields[-1].detach(), "scattering_channels": channels[-1],
        "fields": len(fields), "margin": MARGIN,
        "depth": depth, "height": height, "width": width, "pitch": pitch,
    }  # fmt: skip
    made = {
        "larger": larger, "occupied": occupied, "ranges": ranges,
        "tops": tops, "densest": densest,
    }  # fmt: skip
    bits = torch.finfo(larger.dtype).bits
    _kernel("surround_row", bits).launch(rows, given, made)
    _kernel("reach_row", bits).launch(len(densest), given, made, threads=1)
    return list(larger.split(sizes)), ranges, densest


@functools.cache
def _kernel(function: str, bits: int) -> TextKernel:
    return struct_kernel(function, bits, "surround.h", "Surrounded", function)
