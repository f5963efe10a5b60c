"""Cotangents of the diffusion operator in one pass over the light and its adjoint (E9)."""

import functools
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon.kernels.launch import array, launch
from ddrecon.kernels.native import number_type, program

ROW = """
typedef long long Size;
const int z = row / ny, y = row - z * ny;
const Size slice = (Size)ny * nx, cells = nz * slice;
for (int c = 0; c < colors; ++c) {
    const F* __restrict a = &adjoint.data[c * cells + (Size)row * nx];
    const F* __restrict b = &light.data[c * cells + (Size)row * nx];
    // What all colors share gets the sum of what each would get.
    const auto place = [&](int k, Size count) { return shared.data[k] ? 0 : c * count; };
    const auto is_sum = [&](int k) { return c > 0 && shared.data[k]; };
    const auto faces = [&](F* __restrict out, Size to, int count, bool adds) {
        for (int i = 0; i < count; ++i) {
            const F product = (a[i] - a[i + to]) * (b[i + to] - b[i]);
            out[i] = adds ? out[i] + product : product;
        }
    };
    F* __restrict out = &loss_bar.data[place(0, cells) + (Size)row * nx];
    const bool adds = is_sum(0);
    for (int i = 0; i < nx; ++i) out[i] = adds ? out[i] - a[i] * b[i] : -a[i] * b[i];
    if (z < nz - 1) faces(z_bar.data + place(1, cells - slice) + (Size)row * nx, slice, nx,
        is_sum(1));
    if (y < ny - 1)
        faces(y_bar.data + place(2, cells - nz * nx) + ((Size)z * (ny - 1) + y) * nx, nx, nx,
            is_sum(2));
    faces(x_bar.data + place(3, cells - nz * ny) + (Size)row * (nx - 1), 1, nx - 1, is_sum(3));
}
"""


@functools.cache
def cotangents_kernel(bits: int) -> Any:
    """loss_bar and c_bar of a row of cells, for all colors."""
    F = number_type(bits)

    @wp.func_native(program(bits, ROW))
    def row_of_cotangents(
        row: int,
        colors: int,
        nz: int,
        ny: int,
        nx: int,
        shared: wp.array(dtype=wp.int32),
        adjoint: wp.array(dtype=F),
        light: wp.array(dtype=F),
        loss_bar: wp.array(dtype=F),
        z_bar: wp.array(dtype=F),
        y_bar: wp.array(dtype=F),
        x_bar: wp.array(dtype=F),
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def find_cotangents(
        first: int,
        colors: int,
        nz: int,
        ny: int,
        nx: int,
        shared: wp.array(dtype=wp.int32),
        adjoint: wp.array(dtype=F),
        light: wp.array(dtype=F),
        loss_bar: wp.array(dtype=F),
        z_bar: wp.array(dtype=F),
        y_bar: wp.array(dtype=F),
        x_bar: wp.array(dtype=F),
    ):
        row_of_cotangents(first + wp.tid(), colors, nz, ny, nx, shared, adjoint, light, loss_bar,
                          z_bar, y_bar, x_bar)  # fmt: skip

    return find_cotangents


def find_cotangents(like: tuple[Tensor, ...], adjoint: Tensor, u: Tensor) -> tuple[Tensor, ...]:
    """loss_bar and c_bar of each axis, of the shapes of `like`, the loss and the conductances.

    `adjoint` and `u`: lambda and the light [C, z, y, x].
    """
    colors, *shape = u.shape
    bars = tuple(torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in like)
    shared = _shared(tuple(len(tensor) < colors for tensor in like), u.device)
    flat = [array(tensor.reshape(-1)) for tensor in (adjoint, u, *bars)]
    kernel = cotangents_kernel(u.element_size() * 8)
    launch(kernel, shape[0] * shape[1], [colors, *shape, shared, *flat], u)
    return bars


@functools.cache
def _shared(is_shared: tuple[bool, ...], device: torch.device) -> Any:
    return array(torch.tensor(is_shared, dtype=torch.int32, device=device))
