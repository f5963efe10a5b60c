"""Products with sparse matrices by a kernel: it sums each row in the order of its entries."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from torch import Tensor

from ddrecon.kernels.text import TextKernel

if TYPE_CHECKING:
    from ddrecon.march.faces import _Table


def add_product(table: _Table, values: Tensor, total: Tensor | None) -> Tensor:
    """As `_Table.times`."""
    count, size = len(table.filled), (len(values), table.height)
    arrays = {name: getattr(table, name) for name in ("starts", "filled", "columns", "weights")}
    numbers = {"count": count, "height": table.height, "width": values.shape[1]}
    numbers["adds"] = total is not None or count < table.height
    if total is None:
        total = values.new_zeros(size) if count < table.height else values.new_empty(size)
    kernel = _kernel(8 * values.itemsize)
    kernel.launch(size[0] * count, arrays | numbers | {"values": values}, {"total": total})
    return total


@functools.cache
def _kernel(bits: int) -> TextKernel:
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
