"""Arrays to which many items of a kernel add, and which come to the same bits each time.

A processor's threads add to copies of their own, which are then added one after another. On a GPU
items add in any order: to whole numbers, as `add_to` of `numbers.h` has it. Products with sparse
matrices, whose rows are items, need neither.
"""

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.launch import count_shares, thread_count
from ddrecon.kernels.text import TextKernel


class Sums:
    """Zeros shaped as `shapes`, where tensors `like` this lie; None of what is not asked for.

    Each thread adds to one of `copies`.
    """

    def __init__(self, shapes: Sequence[torch.Size | None], like: Tensor):
        self._shapes, self._like = shapes, like
        count = sum(shape.numel() for shape in shapes if shape is not None)
        dtype = torch.int64 if like.is_cuda else like.dtype
        threads = count_shares(thread_count(like), count * like.itemsize)
        self._flat = [like.new_zeros(count, dtype=dtype) for _ in range(threads)]
        self.copies = [self._cut(flat) for flat in self._flat]

    def total(self, bounds: Tensor | None, cells: int) -> list[Tensor | None]:
        """All sums. On a GPU no number of channel k exceeds `bounds`[k], float64.

        A channel has so many `cells`, but the last, which has the rest.
        """
        total, *others = self._flat
        for flat in others:
            total += flat
        if bounds is not None:
            whole, total = total, self._like.new_empty(len(total))
            arguments = {"whole": whole, "bounds": bounds, "cells": cells, "count": len(bounds)}
            _kernel(8 * total.itemsize).launch(len(total), arguments, {"total": total})
        return self._cut(total)

    def _cut(self, flat: Tensor) -> list[Tensor | None]:
        pieces = iter(flat.split([shape.numel() for shape in self._shapes if shape is not None]))
        return [None if shape is None else next(pieces).view(shape) for shape in self._shapes]


def type_of_sums(like: Tensor) -> str:
    """What kernels declare sums as, where tensors `like` this lie."""
    return "long" if like.is_cuda else "F"


@functools.cache
def _kernel(bits: int) -> TextKernel:
    text = """
    const int k = item / cells, last = count - 1;
    total[item] = F((double)whole[item] / scale_of<double>(bounds[k < last ? k : last]));
    """
    declared = "long *whole; double *bounds; int cells, count; F *total"
    return TextKernel("sums", bits, text, declared, "total")


def add_product(table: Any, values: Tensor, total: Tensor | None) -> Tensor:
    """As `_Table.times` of `march.faces`: each row is summed in the order of its entries."""
    count, size = len(table.filled), (len(values), table.height)
    arrays = {name: getattr(table, name) for name in ("starts", "filled", "columns", "weights")}
    numbers = {"count": count, "height": table.height, "width": values.shape[1]}
    numbers["adds"] = total is not None or count < table.height
    if total is None:
        total = values.new_zeros(size) if count < table.height else values.new_empty(size)
    kernel = _product_kernel(8 * values.itemsize)
    kernel.launch(size[0] * count, arrays | numbers | {"values": values}, {"total": total})
    return total


@functools.cache
def _product_kernel(bits: int) -> TextKernel:
    text = """
    const int row = item % count;
    const long long color = item / count;
    F* const result = total + color * height + filled[row];
    F sum = adds ? *result : 0;
    for (int k = starts[row]; k < starts[row + 1]; ++k)
        sum += weights[k] * values[color * width + columns[k]];
    *result = sum;
    """
    declared = "int *starts, *filled, *columns, count, height, width; bool adds;"
    declared += "F *weights, *values, *total"
    return TextKernel("sparse_product", bits, text, declared, "total")
