"""Fields of coefficients with empty cells around them, and where their rows are not empty."""

import functools
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from ddrecon.diffusion.rounds.fused.rows import MARGIN
from ddrecon.kernels.text import TextKernel

FAR = 64
"""Cells beyond the ends of a row, where an empty one ends and begins."""
_COPY = (
    f"const int FAR = {FAR};"
    + """
const int z = item / (height + 2) - 1, y = item % (height + 2) - 1;
const bool is_inside = z >= 0 && z < depth && y >= 0 && y < height;
const long long rows = (long long)(depth + 2) * (height + 2);
int from = width + FAR, to = -FAR;
for (int channel = 0; channel < channels; ++channel) {
    F* out = larger + margin + (channel * rows + item) * pitch;
    const F* in = cells + (is_inside ? (((long long)channel * depth + z) * height + y) * width : 0);
    for (int c = 0; c < pitch; ++c) out[c] = F(0);
    if (!is_inside) continue;
    for (int c = 0; c < width; ++c) out[c] = in[c];
    for (int c = 0; c < width; ++c) {
        const int one = in[c] != F(0) ? c : from, other = in[c] != F(0) ? c + 1 : to;
        from = one < from ? one : from;
        to = other > to ? other : to;
    }
}
if (is_inside) {
    const int row = z * height + y, all = depth * height;
    occupied[row] = -from > occupied[row] ? -from : occupied[row];
    occupied[all + row] = to > occupied[all + row] ? to : occupied[all + row];
}
"""
)


def surround(fields: Sequence[Tensor], pitch: int) -> tuple[list[Tensor], Tensor]:
    """`fields` [K, z, y, x], with empty cells around them, flat; and `ranges` of their rows.

    Flat they are MARGIN zeros and [K, z + 2, y + 2, pitch]. `ranges` [z, y, 4]: from and to where
    steps to the cells of a row meet a medium, and where those meet one that begin at these cells.
    They begin where vectors do; empty ones are from 0 to 0.
    """
    _, depth, height, width = fields[0].shape
    rows = (depth + 2) * (height + 2)
    none = torch.full((2, depth, height), -width - FAR, dtype=torch.int32)
    occupied = none.to(fields[0].device)
    larger = []
    for field in fields:
        result = field.new_empty(MARGIN + len(field) * rows * pitch)
        result[:MARGIN] = 0
        given = {
            "cells": field.detach(), "channels": len(field), "depth": depth, "height": height,
            "width": width,
            "pitch": pitch, "margin": MARGIN,
        }  # fmt: skip
        kernel = copy_kernel(torch.finfo(field.dtype).bits)
        kernel.launch(rows, given, {"larger": result, "occupied": occupied})
        larger.append(result)
    return larger, _ranges(occupied, width)


def _ranges(occupied: Tensor, width: int) -> Tensor:
    """As `surround` has them, of minus from and to where rows are not empty, `occupied`."""
    found = []
    # Light at the ends of a step is a cell away at most, along each axis.
    reach = occupied.float()
    for _ in range(2):
        reach = max_pool2d(reach, 3, 1, 1) + 1
        start, end = -reach[0], reach[1]
        start = (start / MARGIN).floor().clamp(min=0) * MARGIN
        end = ((end / MARGIN).ceil() * MARGIN).clamp(max=width)
        is_met = start < end
        found += [start * is_met, end * is_met]
    return torch.stack(found, -1).int().contiguous()


@functools.cache
def copy_kernel(bits: int) -> TextKernel:
    """The kernel that copies a row and finds where it is not empty."""
    given = "F *cells, *larger; int *occupied; int channels, depth, height, width, pitch, margin"
    return TextKernel("surround_rows", bits, _COPY, given)
