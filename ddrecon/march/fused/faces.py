"""Products with sparse matrices by a kernel: it sums each row in the order of its entries."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from torch import Tensor

from ddrecon.kernels.text import TextKernel

if TYPE_CHECKING:
    from ddrecon.march.faces import _Table


def add_product(table: _Table, total: Tensor, values: Tensor) -> Tensor:
    """As `_Table.add_to`."""
    count = len(table.filled)
    arrays = {name: getattr(table, name) for name in ("starts", "filled", "columns", "weights")}
    sizes = {"count": count, "height": table.height, "width": values.shape[1]}
    kernel = _kernel(8 * values.itemsize)
    kernel.launch(len(values) * count, arrays | sizes | {"values": values}, {"total": total})
    return total


@functools.cache
def _kernel(bits: int) -> TextKernel:
    text = """
    const int row = item % count;
    const long long color = item / count;
    F sum = 0;
    for (int k = starts[row]; k < starts[row + 1]; ++k)
        sum += weights[k] * values[color * width + columns[k]];
    total[color * height + filled[row]] += sum;
    """
    declared = "int *starts, *filled, *columns, count, height, width; F *weights, *values, *total"
    return TextKernel("sparse_product", bits, text, declared, "total")
