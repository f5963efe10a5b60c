"""A u of the diffusion operator, S - A u, and cotangents, in one pass over the light (E7, E9)."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.kernels.text import TextKernel
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly


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
    product, matrix = u.new_empty(u.shape), (loss, z, y, x)
    given = {"matrix": matrix, "light": u, "begun": begun, "sign": sign}
    kernel = product_kernel(begun is not None, 8 * u.element_size())
    items, mesh = _rows(u, matrix)
    kernel.launch(len(u) * items, mesh | given, {"product": product})
    return product


def find_cotangents(like: tuple[Tensor, ...], adjoint: Tensor, u: Tensor) -> tuple[Tensor, ...]:
    """loss_bar and c_bar of each axis, of the shapes of `like`, the loss and the conductances.

    `adjoint` and `u`: lambda and the light [C, z, y, x].
    """
    bars = [each.new_empty(each.shape) for each in like]
    items, mesh = _rows(u, like)
    given = {"adjoint": adjoint, "light": u}
    cotangents_kernel(8 * u.element_size()).launch(items, mesh | given, {"bars": bars})
    return tuple(bars)


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
    def jvp(ctx: Any, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            (u, *matrix), changes = tensors[:5], tensors[5:]
            d_right, d_u, *d_matrix = (
                torch.zeros_like(value) if d_value is None else d_value
                for value, d_value in zip((u, u, *matrix), changes, strict=True)
            )
            # dS - A du - dA u
            found = multiply(d_u, *matrix, begun=d_right, sign=-1)
            return multiply(u, *d_matrix, begun=found, sign=-1)

        d_imbalance: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_imbalance


def _rows(u: Tensor, matrix: Sequence[Tensor]) -> tuple[int, dict[str, Any]]:
    """Rows of a color, and what kernels are given of them and of the `matrix`."""
    colors, nz, ny, nx = u.shape
    width = 1 if u.is_cuda else nx
    rows = nz * ny * nx // width
    is_each = [len(part) == colors for part in matrix]
    names = "width", "rows", "colors", "nz", "ny", "nx", "is_each"
    values = width, rows, colors, nz, ny, nx, is_each
    return rows, dict(zip(names, values, strict=True))


_HEADER = "diffusion/fused/product.h"
_ROWS = "int width, rows, colors, nz, ny, nx, is_each[4];"
_TEXT = """
const Row row(item, width, rows, colors);
const Mesh<F> mesh(row, nz, ny, nx, F(1), F(1), F(1));
"""


@functools.cache
def product_kernel(is_begun: bool, bits: int) -> TextKernel:
    """The kernel of A u; loss and conductances have all colors or one."""
    call = f"multiply<{int(is_begun)}>(row, mesh, F(sign), is_each, matrix, light, begun, product);"
    given = _ROWS + "int sign; F *matrix[4], *light, *begun, *product"
    return TextKernel("multiply_operator", bits, _TEXT + call, given, "product", _HEADER)


@functools.cache
def cotangents_kernel(bits: int) -> TextKernel:
    """The kernel of loss_bar and c_bar, of a row of cells in all colors."""
    call = "find_matrix_bars(row, mesh, colors, is_each, adjoint, light, bars);"
    given = _ROWS + "F *adjoint, *light, *bars[4]"
    return TextKernel("matrix_bars", bits, _TEXT + call, given, "bars", _HEADER)
