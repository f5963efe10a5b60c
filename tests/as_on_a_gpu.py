"""Fused kernels on the processor as a GPU runs them: an item a cell, in any order.

Whoever asks whether a tensor `is_cuda` is told that it is, and kernels are compiled with the GPU's
branches of their headers. Items run one after another: where one reads what another one writes,
another order gives other numbers.
"""

import contextlib
import functools
import inspect
import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any
from unittest.mock import patch

import warp as wp
from torch import Tensor

from ddrecon.kernels import text

ORDERS: dict[str, Callable[[int], int]] = {
    "forward": lambda count: 1,
    "scattered": lambda count: next(
        step for step in range(int(0.618 * count) + 1, count + 2) if math.gcd(step, count) == 1
    ),
}
"""The step from an item to the next one, modulo their number."""


@contextlib.contextmanager
def as_on_a_gpu(order: str = "forward") -> Iterator[Collection[Any]]:
    """Runs kernels as on a GPU, with their items in one of `ORDERS`.

    Yields the kernels that are launched meanwhile, in their order.
    """
    kernels: dict[Any, None] = {}

    def launch(kernel: Any, count: int, records: Any, _: Tensor, threads: Any = None) -> None:
        assert threads in (None, 1), "a GPU has no shares"
        (record,) = records
        kernels[kernel] = None
        wp.launch(_reordered(kernel), count, [ORDERS[order](count), count, record], device="cpu")

    with (
        patch.object(Tensor, "is_cuda", True),
        patch.object(Tensor, "is_cpu", False),
        patch.object(text, "launch", launch),
    ):
        yield kernels


def headers_of(kernels: Iterable[Any]) -> set[str]:
    """The headers that `kernels` were compiled from, by path."""
    return {
        path for one in kernels for path in re.findall('#line 1 "ddrecon/(.*)"', _preamble(one))
    }


def _preamble(kernel: Any) -> str:
    preamble: str = kernel.module.options["extra_build_options"].extra_cpu_preamble
    return preamble


@functools.cache
def _reordered(kernel: Any) -> Any:
    """`kernel` with the GPU's branches: item (tid step) % count, for each thread's number tid."""
    do_item, Record = inspect.getclosurevars(kernel.func).nonlocals["do_item"], kernel.adj.args[1]
    preamble = f"#define DDRECON_AS_ON_A_GPU\n{_preamble(kernel)}"
    options = {"extra_build_options": wp.ModuleBuildOptions(extra_cpu_preamble=preamble)}

    @wp.kernel(enable_backward=False, module="unique", name=kernel.key, module_options=options)
    def do_items(step: int, count: int, given: Record.type):
        do_item(int(wp.int64(wp.tid()) * wp.int64(step) % wp.int64(count)), given)

    return do_items
