"""The integral of a field along straight ways, from a point light to cells, by fused kernels.

`light.point_light` is the definition. A way ends in a cell, and those of neighboring cells run
beside each other.
"""

import functools
import math
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.kernels.launch import array, launch, thread_count
from ddrecon.kernels.native import number_type, program
from ddrecon.light.fused.point_light_code import ADJOINT, INTEGRATE
from ddrecon.numerics.autodiff import differentiate_once

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

    Differentiable by all but `fraction`.
    """

    @staticmethod
    def forward(
        ctx: Any, field: Tensor, first: Tensor, last: Tensor, length: Tensor, fraction: Tensor
    ) -> Tensor:
        ctx.save_for_backward(field, first, last, length, fraction)
        total = field.new_empty(len(field), len(length))
        ways = _ways(field, first, last, length, fraction, total=total)
        kernel = way_kernels(field.element_size() * 8).integrate
        launch(kernel, _items(length), [ways], field)
        return total

    @staticmethod
    @differentiate_once
    def backward(ctx: Any, total_bar: Tensor) -> tuple[Tensor | None, ...]:
        field, first, last, length, fraction = ctx.saved_tensors
        varies = any(ctx.needs_input_grad[1:4])
        bars = [each.new_zeros(each.shape if varies else 0) for each in (first, last, length)]
        # Each thread adds to cells of its own: the same bits, whichever of them is faster.
        shares = [field.new_zeros(field.shape) for _ in range(thread_count(field))]
        names = "first_bar", "last_bar", "length_bar"
        given = dict(zip(names, bars, strict=True), total=total_bar)
        ways = [
            _ways(field, first, last, length, fraction, field_bar=share, **given)
            for share in shares
        ]
        for each in ways:
            each.varies = varies
        kernel = way_kernels(field.element_size() * 8).adjoint
        launch(kernel, _items(length), lambda i: [ways[i]], field)
        found = bars if varies else [None, None, None]
        return functools.reduce(Tensor.add_, shares), *found, None


def _items(length: Tensor) -> int:
    return math.ceil(len(length) / (1 if length.is_cuda else BLOCK))


def _ways(
    field: Tensor, first: Tensor, last: Tensor, length: Tensor, fraction: Tensor, **more: Tensor
) -> Any:
    """The record that kernels are given."""
    ways = way_kernels(field.element_size() * 8).Ways()
    ways.count, ways.samples, ways.channels = len(length), len(fraction), len(field)
    ways.depth, ways.height, ways.width = field.shape[1:]
    tensors = {"field": field, "first": first, "last": last, "length": length}
    for name, tensor in (tensors | {"fraction": fraction} | more).items():
        setattr(ways, name, array(tensor.reshape(-1)))
    return ways


@functools.cache
def way_kernels(bits: int) -> SimpleNamespace:
    """The kernels for numbers of so many `bits`, and the record `Ways` that they are given."""
    F = number_type(bits)

    @wp.struct
    class Ways:
        """What `_Integral` is given, and cotangents; `total` is the integral, or its cotangent."""

        count: int
        samples: int
        channels: int
        depth: int
        height: int
        width: int
        varies: bool
        field: wp.array(dtype=F)
        first: wp.array(dtype=F)
        last: wp.array(dtype=F)
        length: wp.array(dtype=F)
        fraction: wp.array(dtype=F)
        total: wp.array(dtype=F)
        field_bar: wp.array(dtype=F)
        first_bar: wp.array(dtype=F)
        last_bar: wp.array(dtype=F)
        length_bar: wp.array(dtype=F)

    def kernel(body: str) -> Any:
        @wp.func_native(program(bits, body))
        def do_item(item: int, ways: Ways): ...

        @wp.kernel(enable_backward=False, module="unique")
        def do_items(first: int, ways: Ways):
            do_item(first + wp.tid(), ways)

        return do_items

    return SimpleNamespace(Ways=Ways, integrate=kernel(INTEGRATE), adjoint=kernel(ADJOINT))
