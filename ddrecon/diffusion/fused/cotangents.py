"""Cotangents of the diffusion operator in one pass over the light and its adjoint (E9)."""

from __future__ import annotations

import functools

from torch import Tensor

from ddrecon.kernels.text import TextKernel

_ROW = """
typedef long long Size;
const int row = item, z = row / ny, y = row - z * ny;
const int shared[4] = {shared_loss, shared_z, shared_y, shared_x};
const Size slice = (Size)ny * nx, cells = nz * slice;
for (int c = 0; c < colors; ++c) {
    const F* __restrict a = &adjoint[c * cells + (Size)row * nx];
    const F* __restrict b = &light[c * cells + (Size)row * nx];
    // What all colors share gets the sum of what each would get.
    const auto place = [&](int k, Size count) { return shared[k] ? 0 : c * count; };
    const auto is_sum = [&](int k) { return c > 0 && shared[k]; };
    const auto faces = [&](F* __restrict out, Size to, int count, bool adds) {
        for (int i = 0; i < count; ++i) {
            const F product = (a[i] - a[i + to]) * (b[i + to] - b[i]);
            out[i] = adds ? out[i] + product : product;
        }
    };
    F* __restrict out = &loss_bar[place(0, cells) + (Size)row * nx];
    const bool adds = is_sum(0);
    for (int i = 0; i < nx; ++i) out[i] = adds ? out[i] - a[i] * b[i] : -a[i] * b[i];
    if (z < nz - 1) faces(z_bar + place(1, cells - slice) + (Size)row * nx, slice, nx,
        is_sum(1));
    if (y < ny - 1)
        faces(y_bar + place(2, cells - nz * nx) + ((Size)z * (ny - 1) + y) * nx, nx, nx,
            is_sum(2));
    faces(x_bar + place(3, cells - nz * ny) + (Size)row * (nx - 1), 1, nx - 1, is_sum(3));
}
"""


_GIVEN = """
int colors, nz, ny, nx, shared_loss, shared_z, shared_y, shared_x;
F *adjoint, *light, *loss_bar, *z_bar, *y_bar, *x_bar;
"""


@functools.cache
def cotangents_kernel(bits: int) -> TextKernel:
    """loss_bar and c_bar of a row of cells, for all colors."""
    return TextKernel("find_cotangents", bits, _ROW, _GIVEN, "loss_bar z_bar y_bar x_bar")


def find_cotangents(like: tuple[Tensor, ...], adjoint: Tensor, u: Tensor) -> tuple[Tensor, ...]:
    """loss_bar and c_bar of each axis, of the shapes of `like`, the loss and the conductances.

    `adjoint` and `u`: lambda and the light [C, z, y, x].
    """
    colors, nz, ny, nx = u.shape
    names, bars = ("loss", "z", "y", "x"), [each.new_empty(each.shape) for each in like]
    given = {"colors": colors, "nz": nz, "ny": ny, "nx": nx, "adjoint": adjoint, "light": u}
    shared = {f"shared_{name}": len(bar) < colors for name, bar in zip(names, bars, strict=True)}
    made = {f"{name}_bar": bar for name, bar in zip(names, bars, strict=True)}
    cotangents_kernel(u.element_size() * 8).launch(nz * ny, given | shared, made)
    return tuple(bars)
