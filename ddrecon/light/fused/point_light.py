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
from ddrecon.kernels.launch import launch_later
from ddrecon.kernels.sums import Sums, type_of_sums
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
            launch_later(way_kernel(type_of_sums(field), 8 * field.itemsize).kernel, field)
        return _integrate(field, first, last, length, fraction)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        keep(ctx, *inputs)

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, total_bar: Tensor) -> tuple[Tensor | None, ...]:
        field, *ways = ctx.saved_tensors
        items, _ = cut(len(ways[2]), BLOCK, field)
        sums, bounds = Sums([field.shape], field), None
        if field.is_cuda:
            bounds = (total_bar * ways[2]).abs().sum(1, dtype=torch.float64)
        arguments = _ways(field, *ways) | {"total": total_bar, "bounds": bounds}
        way_kernel(type_of_sums(field), 8 * field.itemsize).launch(
            items, arguments, {}, shares=[{"field_bar": bar} for (bar,) in sums.copies]
        )
        (field_bar,) = sums.total(bounds, field[0].numel())
        return field_bar, None, None, None, None

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
    way_kernel("", 8 * field.itemsize).launch(items, _ways(field, *ways), {"total": total})
    return total


_SIZES = "ways, samples, channels, depth, height, width"
_ARRAYS = "field, first, last, length, fraction"


def _ways(field: Tensor, *ways: Tensor) -> dict[str, Any]:
    """What both kernels read."""
    sizes = len(ways[2]), len(ways[3]), *field.shape
    names = f"{_SIZES}, {_ARRAYS}".split(", ")
    return dict(zip(names, (*sizes, field, *ways), strict=True))


@functools.cache
def way_kernel(sums: str, bits: int) -> TextKernel:
    """The kernel of integrals along ways; of `sums`, their type, its adjoint from `total`."""
    call = "integrate_back(item, total, bounds, field_bar)" if sums else "integrate(item, total)"
    text = f"Ways<F, IS_GPU ? 1 : {BLOCK}>{{{_SIZES}, {_ARRAYS}}}.{call};"
    declared = f"int {_SIZES}; F *{', *'.join(_ARRAYS.split(', '))}, *total"
    header, name = "light/fused/point_light.h", f"ways{'_adjoint' * bool(sums)}"
    if sums:
        declared += f"; double *bounds; {sums} *field_bar"
    return TextKernel(name, bits, text, declared, "field_bar" if sums else "total", header)
