"""Cells with y and x exchanged, in tiles that a processor's cache holds.

The files of kernels have no postponed annotations: Warp reads the types of arguments.
"""

import functools
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon.kernels.launch import array, launch
from ddrecon.kernels.native import number_type, program
from ddrecon.kernels.spare import borrow

TILE = 16
"""Rows and columns that are exchanged at a time."""
_TILES = f"""
const int TILE = {TILE};
const long long size = (long long)height * width, at = plane * size;
for (int top = 0; top < height; top += TILE) {{
    const int bottom = top + TILE < height ? top + TILE : height;
    for (int left = 0; left < width; left += TILE) {{
        const int right = left + TILE < width ? left + TILE : width;
"""
_TURN = (
    _TILES
    + """
        for (int x = left; x < right; ++x)
            for (int y = top; y < bottom; ++y)
                turned.data[at + (long long)x * height + y]
                    = cells.data[at + (long long)y * width + x];
    }
}
"""
)
_ADD = (
    _TILES
    + """
        F sum[TILE * TILE];
        for (int x = left; x < right; ++x)
            for (int y = top; y < bottom; ++y)
                sum[(y - top) * TILE + x - left] = turned.data[at + (long long)x * height + y];
        for (int y = top; y < bottom; ++y)
            for (int x = left; x < right; ++x)
                cells.data[at + (long long)y * width + x] += sum[(y - top) * TILE + x - left];
    }
}
"""
)


def turn(cells: Tensor) -> Tensor:
    """`cells` [..., y, x] as [..., x, y], in borrowed memory."""
    if cells.is_cuda:
        return cells.transpose(-1, -2).contiguous()
    *planes, height, width = cells.shape
    turned = borrow(cells.numel(), cells).view(*planes, width, height)
    count = turned.numel() // (height * width)
    kernel = _kernels(torch.finfo(cells.dtype).bits).turn_planes
    launch(kernel, count, [*map(_flat, (cells, turned)), height, width], cells)
    return turned


def add_turned(cells: Tensor, turned: Tensor) -> Tensor:
    """`cells` [..., y, x] with `turned` [..., x, y] added, in the same memory."""
    if cells.is_cuda:
        return cells.add_(turned.transpose(-1, -2))
    *_, height, width = cells.shape
    count = cells.numel() // (height * width)
    kernel = _kernels(torch.finfo(cells.dtype).bits).add_planes
    launch(kernel, count, [*map(_flat, (cells, turned)), height, width], cells)
    return cells


def _flat(tensor: Tensor) -> Any:
    return array(tensor.detach().reshape(-1))


@functools.cache
def _kernels(bits: int) -> SimpleNamespace:
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _TURN))
    def turn_plane(
        cells: wp.array(dtype=F), turned: wp.array(dtype=F), plane: int, height: int, width: int
    ): ...

    @wp.func_native(program(bits, _ADD))
    def add_plane(
        cells: wp.array(dtype=F), turned: wp.array(dtype=F), plane: int, height: int, width: int
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def turn_planes(
        first: int, cells: wp.array(dtype=F), turned: wp.array(dtype=F), height: int, width: int
    ):
        turn_plane(cells, turned, first + wp.tid(), height, width)

    @wp.kernel(enable_backward=False, module="unique")
    def add_planes(
        first: int, cells: wp.array(dtype=F), turned: wp.array(dtype=F), height: int, width: int
    ):
        add_plane(cells, turned, first + wp.tid(), height, width)

    return SimpleNamespace(turn_planes=turn_planes, add_planes=add_planes)
