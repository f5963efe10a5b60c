"""S - A u of the diffusion operator in one pass over the light (E2.7, E3.2)."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.kernels.text import TextKernel
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

KERNELS = {
    "subtract_product": (
        "found",
        "is_each, matrix, light, begun, found",
        "int is_each[4]; F *matrix[4], *light, *begun, *found",
    ),
    "find_cotangents": ("bars", "adjoint, light, bars", "F *adjoint, *light, *bars[4]"),
}
"""What the kernels write, what they are called with, and what that is."""


def subtract_product(
    begun: Tensor, u: Tensor, loss: Tensor, z: Tensor, y: Tensor, x: Tensor
) -> Tensor:
    """What is `begun` less A u [C, z, y, x], for the `loss` and the conductances along all axes."""
    found, matrix = u.new_empty(u.shape), (loss, z, y, x)
    given = {"matrix": matrix, "is_each": [len(part) == len(u) for part in matrix], "begun": begun}
    _launch("subtract_product", given | {"light": u}, {"found": found})
    return found


def find_cotangents(operator: Operator, adjoint: Tensor, u: Tensor) -> tuple[Tensor, ...]:
    """What `operator.cotangents` returns."""
    like = operator.loss, *operator.conductances
    bars = [u.new_empty(len(u), *part.shape[1:]) for part in like]
    _launch("find_cotangents", {"adjoint": adjoint, "light": u}, {"bars": bars})
    return tuple(bar.sum_to_size(part.shape) for bar, part in zip(bars, like, strict=True))


def _launch(name: str, given: dict[str, Any], made: dict[str, Any]) -> None:
    light = given["light"]
    colors, nz, ny, nx = light.shape
    width = 1 if light.is_cuda else nx
    rows = nz * ny * nx // width
    given |= {"width": width, "rows": rows, "colors": colors, "nz": nz, "ny": ny, "nx": nx}
    product_kernel(name, 8 * light.element_size()).launch(colors * rows, given, made)


def find_imbalance(operator: Operator, right: Tensor, u: Tensor) -> Tensor:
    """`right` - A u [C, z, y, x]."""
    imbalance: Tensor = _Imbalance.apply(right, u, operator.loss, *operator.conductances)
    return imbalance


class _Imbalance(torch.autograd.Function):
    """S - A u; its cotangents are those of a solve (E3.2), with it in place of lambda."""

    @staticmethod
    def forward(right: Tensor, u: Tensor, *matrix: Tensor) -> Tensor:
        return subtract_product(right, u, *matrix)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        keep(ctx, *inputs[1:])

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, ...]:
        u, *matrix = ctx.saved_tensors
        u_bar = subtract_product(torch.zeros_like(bar), bar, *matrix)
        return bar, u_bar, *Operator.of({}, *matrix).cotangents(bar, u)

    @staticmethod
    def jvp(ctx: Any, *changes: Tensor | None) -> Tensor:
        def change(*tensors: Any) -> Tensor:
            (u, *matrix), changes = tensors[:5], tensors[5:]
            d_right, d_u, *d_matrix = (
                torch.zeros_like(value) if d_value is None else d_value
                for value, d_value in zip((u, u, *matrix), changes, strict=True)
            )
            # dS - A du - dA u
            return subtract_product(subtract_product(d_right, d_u, *matrix), u, *d_matrix)

        d_imbalance: Tensor = run_plainly(change, *ctx.saved_tensors, *changes)
        return d_imbalance


@functools.cache
def product_kernel(name: str, bits: int) -> TextKernel:
    """The kernel called `name` in `product.h`."""
    made, call, given = KERNELS[name]
    text = f"""
    const Row row(item, width, rows, colors);
    const Mesh<F> mesh(row, nz, ny, nx, F(1), F(1), F(1));
    {name}(row, mesh, {call});
    """
    given = f"int width, rows, colors, nz, ny, nx; {given}"
    return TextKernel(name, bits, text, given, made, "diffusion/fused/product.h")
