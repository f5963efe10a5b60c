"""A u of the diffusion operator in one pass over the light (E7)."""

from __future__ import annotations

import functools
from typing import Any

from torch import Tensor

from ddrecon.diffusion.fused.faces import FACES
from ddrecon.grid import Grid
from ddrecon.kernels.rows import launch_rows, row_kernel

_PRODUCT = """
const F *u = light + c * size + start, *own_loss = loss + color(loss_colors, size) + start;
F* out = product + c * size + start;
const F* cz = conductance_z + color(z_colors, plane * (nz - 1)) + start;
const F* cy
    = conductance_y + color(y_colors, (plane - nx) * nz) + ((long long)z * (ny - 1) + y) * nx;
const F* cx = nx == 1
    ? u : conductance_x + color(x_colors, (size / nx) * (nx - 1)) + (long long)row * (nx - 1);
// Where there is no face, the difference across it is zero.
const F *cz_low = zl ? cz - plane : u, *cz_high = zh ? cz : u;
const F *cy_low = yl ? cy - nx : u, *cy_high = yh ? cy : u;
each([&](int i, bool xl, bool xh, int to_xl, int to_xh) INLINE {
    const F here = u[i];
    out[i] = own_loss[i] * here
        + cz_low[i] * (here - u[i + to_zl]) + cz_high[i] * (here - u[i + to_zh])
        + cy_low[i] * (here - u[i + to_yl]) + cy_high[i] * (here - u[i + to_yh])
        + (xl ? cx[i + to_xl] * (here - u[i + to_xl]) : F(0))
        + (xh ? cx[i] * (here - u[i + to_xh]) : F(0));
});
"""


def multiply(u: Tensor, loss: Tensor, z: Tensor, y: Tensor, x: Tensor) -> Tensor:
    """A u [C, z, y, x] for the `loss` and the conductances along `z`, `y` and `x`."""
    product = u.new_empty(u.shape)
    given: dict[str, Any] = {
        "light": u, "loss": loss, "conductance_z": z, "conductance_y": y, "conductance_x": x,
        "loss_colors": len(loss), "z_colors": len(z), "y_colors": len(y), "x_colors": len(x),
    }  # fmt: skip
    _, depth, height, width = u.shape
    unit = Grid((depth, height, width), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    launch_rows(product_kernel, unit, len(u), given, {"product": product})
    return product


@functools.cache
def product_kernel(bits: int) -> Any:
    """The kernel of A u; loss and conductances have all colors or one."""
    arrays = "light loss conductance_z conductance_y conductance_x product"
    numbers = "loss_colors z_colors y_colors x_colors"
    return row_kernel("multiply_operator", bits, FACES + _PRODUCT, arrays, numbers)
