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

TILE = 16
"""Rows and columns that are exchanged at a time."""
_TILES = f"""
const int TILE = {TILE};
const long long size = (long long)height * width, at = plane * size, total = planes * size;
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
_ADD_UP = (
    _TILES
    + """
        F sum[TILE * TILE];
        for (int i = 0; i < TILE * TILE; ++i) sum[i] = F(0);
        for (int t = 0; t < turned_shares; ++t)
            for (int x = left; x < right; ++x)
                for (int y = top; y < bottom; ++y)
                    sum[(y - top) * TILE + x - left]
                        += turned.data[t * total + at + (long long)x * height + y];
        for (int t = 0; t < shares; ++t)
            for (int y = top; y < bottom; ++y)
                for (int x = left; x < right; ++x)
                    sum[(y - top) * TILE + x - left]
                        += cells.data[t * total + at + (long long)y * width + x];
        for (int y = top; y < bottom; ++y)
            for (int x = left; x < right; ++x)
                out.data[at + (long long)y * width + x] = sum[(y - top) * TILE + x - left];
    }
}
"""
)


def turn(cells: Tensor) -> Tensor:
    """`cells` [..., y, x] as [..., x, y]."""
    if cells.is_cuda:
        return cells.transpose(-1, -2).contiguous()
    *planes, height, width = cells.shape
    turned = cells.new_empty(*planes, width, height)
    count = turned.numel() // (height * width)
    kernel = _kernels(torch.finfo(cells.dtype).bits).turn_planes
    launch(kernel, count, [*map(_flat, (cells, turned)), count, height, width], cells)
    return turned


def add_up(cells: Tensor, turned: Tensor) -> Tensor:
    """The sum over the first dimension of `cells` [N, ..., y, x] and of `turned` [T, ..., x, y]."""
    if cells.is_cuda:
        return cells.sum(0) + turned.sum(0).transpose(-1, -2)
    shares, *_, height, width = cells.shape
    out = torch.empty_like(cells[0])
    count = out.numel() // (height * width)
    sizes = [shares, len(turned), count, height, width]
    kernel = _kernels(torch.finfo(cells.dtype).bits).add_planes
    launch(kernel, count, [*map(_flat, (cells, turned, out)), *sizes], cells)
    return out


def _flat(tensor: Tensor) -> Any:
    return array(tensor.detach().reshape(-1))


@functools.cache
def _kernels(bits: int) -> SimpleNamespace:
    F: Any = number_type(bits)

    @wp.func_native(program(bits, _TURN))
    def turn_plane(
        cells: wp.array(dtype=F),
        turned: wp.array(dtype=F),
        plane: int,
        planes: int,
        height: int,
        width: int,
    ): ...

    @wp.func_native(program(bits, _ADD_UP))
    def add_plane(
        cells: wp.array(dtype=F),
        turned: wp.array(dtype=F),
        out: wp.array(dtype=F),
        shares: int,
        turned_shares: int,
        plane: int,
        planes: int,
        height: int,
        width: int,
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def turn_planes(
        first: int,
        cells: wp.array(dtype=F),
        turned: wp.array(dtype=F),
        planes: int,
        height: int,
        width: int,
    ):
        turn_plane(cells, turned, first + wp.tid(), planes, height, width)

    @wp.kernel(enable_backward=False, module="unique")
    def add_planes(
        first: int,
        cells: wp.array(dtype=F),
        turned: wp.array(dtype=F),
        out: wp.array(dtype=F),
        shares: int,
        turned_shares: int,
        planes: int,
        height: int,
        width: int,
    ):
        plane = first + wp.tid()
        add_plane(cells, turned, out, shares, turned_shares, plane, planes, height, width)

    return SimpleNamespace(turn_planes=turn_planes, add_planes=add_planes)
