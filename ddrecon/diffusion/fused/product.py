"""A u of the diffusion operator, and S - A u, in one pass over the light (E7)."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.fused.cotangents import find_cotangents
from ddrecon.diffusion.fused.faces import FACES
from ddrecon.diffusion.operator import Operator
from ddrecon.grid import Grid
from ddrecon.kernels.rows import launch_rows, row_kernel
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

_PRODUCT = """
const F *u = light + c * size + start, *own_loss = loss + color(loss_colors, size) + start;
const F* before = begun ? begun + c * size + start : u;
F* out = product + c * size + start;
const F kept = begun ? F(1) : F(0), times = F(sign);
const F* cz = conductance_z + color(z_colors, plane * (nz - 1)) + start;
const F* cy
    = conductance_y + color(y_colors, (plane - nx) * nz) + ((long long)z * (ny - 1) + y) * nx;
const F* cx = nx == 1
    ? u : conductance_x + color(x_colors, (size / nx) * (nx - 1)) + (long long)row * (nx - 1);
// Where there is no face, the difference across it is zero.
const F *cz_low = zl ? cz - plane : u, *cz_high = zh ? cz : u;
const F *cy_low = yl ? cy - nx : u, *cy_high = yh ? cy : u;
each([&](int i, bool xl, bool xh, int to_xl, int to_xh) HERE {
    const F here = u[i];
    const F change = own_loss[i] * here
        + cz_low[i] * (here - u[i + to_zl]) + cz_high[i] * (here - u[i + to_zh])
        + cy_low[i] * (here - u[i + to_yl]) + cy_high[i] * (here - u[i + to_yh])
        + (xl ? cx[i + to_xl] * (here - u[i + to_xl]) : F(0))
        + (xh ? cx[i] * (here - u[i + to_xh]) : F(0));
    out[i] = kept * before[i] + times * change;
});
"""


def multiply(
    u: Tensor,
    loss: Tensor,
    z: Tensor,
    y: Tensor,
    x: Tensor,
    *,
    begun: Tensor | None = None,
    sign: int = 1,
) -> Tensor:
    """A u [C, z, y, x] for the `loss` and the conductances along `z`, `y` and `x`.

    Times the `sign`, and added to what is `begun`.
    """
    product = u.new_empty(u.shape)
    given: dict[str, Any] = {
        "light": u, "loss": loss, "conductance_z": z, "conductance_y": y, "conductance_x": x,
        "loss_colors": len(loss), "z_colors": len(z), "y_colors": len(y), "x_colors": len(x),
        "begun": begun, "sign": sign,
    }  # fmt: skip
    _, depth, height, width = u.shape
    unit = Grid((depth, height, width), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    launch_rows(product_kernel, unit, len(u), given, {"product": product})
    return product


def find_imbalance(operator: Operator, right: Tensor, u: Tensor) -> Tensor:
    """`right` - A u [C, z, y, x]."""
    imbalance: Tensor = _Imbalance.apply(right, u, operator.loss, *operator.conductances)
    return imbalance


class _Imbalance(torch.autograd.Function):
    """S - A u; its cotangents are those of a solve (E9), with it in place of lambda."""

    @staticmethod
    def forward(right: Tensor, u: Tensor, *matrix: Tensor) -> Tensor:
        return multiply(u, *matrix, begun=right, sign=-1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        keep(ctx, *inputs[1:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, ...]:
        u, *matrix = ctx.saved_tensors
        return bar, multiply(bar, *matrix, sign=-1), *find_cotangents(tuple(matrix), bar, u)

    @staticmethod
    def jvp(ctx: Any, d_right: Tensor | None, d_u: Tensor | None, *d_matrix: Any) -> Tensor:
        def change(u: Tensor, d_right: Tensor | None, d_u: Tensor | None, *tensors: Any) -> Tensor:
            matrix, d_parts = tensors[:4], tensors[4:]
            found = torch.zeros_like(u) if d_right is None else d_right
            # dS - A du - dA u
            if d_u is not None:
                found = multiply(d_u, *matrix, begun=found, sign=-1)
            d_matrix = (
                torch.zeros_like(part) if d_part is None else d_part
                for part, d_part in zip(matrix, d_parts, strict=True)
            )
            return multiply(u, *d_matrix, begun=found, sign=-1)

        u, *matrix = ctx.saved_tensors
        d_imbalance: Tensor = run_plainly(change, u, d_right, d_u, *matrix, *d_matrix)
        return d_imbalance


@functools.cache
def product_kernel(bits: int) -> Any:
    """The kernel of A u; loss and conductances have all colors or one."""
    arrays = "light loss conductance_z conductance_y conductance_x begun"
    numbers = "loss_colors z_colors y_colors x_colors sign"
    return row_kernel("multiply_operator", bits, FACES + _PRODUCT, arrays, "product", numbers)
