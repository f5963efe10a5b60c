"""The integral of a field along straight ways, from a point light to cells, by fused kernels.

`light.point_light` is the definition. A way ends in a cell, and those of neighboring cells run
beside each other.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.launch import count_shares, launch_later, thread_count
from ddrecon.kernels.text import TextKernel, cut
from ddrecon.numerics.autodiff import differentiate_once, keep, run_plainly

BLOCK = 128
"""Ways that one item does on a processor; on a GPU it is one."""


def integrate_ways(
    field: Tensor, grid: Grid, begin: Tensor, end: Tensor, length: Tensor, fraction: Tensor
) -> Tensor:
    """The integral [K, P] of `field` [K, z, y, x] from `begin` to `end` [P, 3], `length` [P] long.

    That is `length` times the mean over samples, which lie the parts `fraction` [M] of the way
    before its end.
    """
    lower, spacing = begin.new_tensor(grid.lower), begin.new_tensor(grid.spacing)
    first, last = (((point - lower) / spacing - 0.5).T.contiguous() for point in (begin, end))
    total: Tensor = _Integral.apply(field, first, last, length, fraction.flatten())
    return total


class _Integral(torch.autograd.Function):
    """The integral; `first` and `last` [3, P] are places counted in cells, 0 in the first's center.

    Differentiable by the field alone.
    """

    @staticmethod
    def forward(
        field: Tensor, first: Tensor, last: Tensor, length: Tensor, fraction: Tensor
    ) -> Tensor:
        if field.requires_grad:
            launch_later(way_kernel(True, 8 * field.itemsize).kernel, field)
        return _integrate(field, first, last, length, fraction)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        keep(ctx, *inputs)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, total_bar: Tensor) -> tuple[Tensor | None, ...]:
        ways = field, *_, length, _ = ctx.saved_tensors
        # Each thread adds to cells of its own: the same bits, whichever of them is faster.
        threads = count_shares(thread_count(field), field.nbytes)
        shares = [field.new_zeros(field.shape) for _ in range(threads)]
        own = [{"fields_bar": share} for share in shares]
        items, _ = cut(len(length), BLOCK, length)
        kernel = way_kernel(True, field.element_size() * 8)
        kernel.launch(items, _ways(*ways) | {"totals": total_bar}, own[0], shares=own)
        return functools.reduce(Tensor.add_, shares), None, None, None, None

    @staticmethod
    def jvp(ctx: Any, d_field: Tensor | None, *_: None) -> Tensor:
        _, *ways = ctx.saved_tensors
        # Linear in the field.
        d_total: Tensor = run_plainly(_integrate, d_field, *ways)
        return d_total


def _integrate(field: Tensor, *ways: Tensor) -> Tensor:
    """The integral of `field` along `ways`."""
    total = field.new_empty(len(field), len(ways[2]))
    items, _ = cut(len(ways[2]), BLOCK, field)
    kernel = way_kernel(False, field.element_size() * 8)
    kernel.launch(items, _ways(field, *ways), {"totals": total})
    return total


def _ways(
    field: Tensor, first: Tensor, last: Tensor, length: Tensor, fraction: Tensor
) -> dict[str, Any]:
    """What both kernels are given."""
    channels, depth, height, width = field.shape
    sizes = {"channels": channels, "depth": depth, "height": height, "width": width}
    sizes |= {"ways": len(length), "samples": len(fraction)}
    arrays = {"fields": field, "firsts": first, "lasts": last, "lengths": length}
    return sizes | arrays | {"fraction": fraction}


_WAYS = "ways, samples, channels, depth, height, width, fields, firsts, lasts, lengths, fraction"
_GIVEN = """
int ways, samples, channels, depth, height, width;
F *fields, *firsts, *lasts, *lengths, *fraction, *totals, *fields_bar
"""


@functools.cache
def way_kernel(is_adjoint: bool, bits: int) -> TextKernel:
    """The kernel of integrals along ways, `totals`; or its adjoint, from cotangents `totals`."""
    made = "fields_bar" if is_adjoint else "totals"
    call = "integrate_back(item, totals, fields_bar)" if is_adjoint else "integrate(item, totals)"
    text = f"Ways<F, IS_GPU ? 1 : {BLOCK}>{{{_WAYS}}}.{call};"
    name = f"ways{'_adjoint' * is_adjoint}"
    return TextKernel(name, bits, text, _GIVEN, made, "light/fused/point_light.h")
