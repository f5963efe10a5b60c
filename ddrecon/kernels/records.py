"""Kernels in a text whose arrays and whole numbers are named one by one (`TextKernel`)."""

from __future__ import annotations

import functools
from collections.abc import Mapping

from torch import Tensor

from ddrecon.kernels.launch import launch
from ddrecon.kernels.text import TextKernel

_TYPES = {"": "F", "real": "F", "whole": "int", "double": "double"}


@functools.cache
def record_kernel(name: str, bits: int, text: str, arrays: str, numbers: str = "") -> TextKernel:
    """The kernel `name` that does `text`, C++ as of `program`, for each `item`.

    The text has pointers called as the `arrays`, of numbers `F` or, where it says so
    (`whole:items double:sums`), of whole ones or of double precision; and whole `numbers`.
    """
    given = ""
    for one in arrays.split():
        kind, _, array = one.rpartition(":")
        given += f"{_TYPES[kind]} *{array};"
    given += "".join(f"int {one};" for one in numbers.split())
    return TextKernel(name, bits, text, given)


def launch_record(
    kernel: TextKernel,
    count: int,
    values: Mapping[str, Tensor | int],
    like: Tensor,
    threads: int | None = None,
    work: int | None = None,
) -> None:
    """Runs `kernel` for `count` items of contiguous arrays and numbers, `values` by name.

    `threads` and `work` as of `launch`.
    """
    record = kernel.new_record()
    for name in kernel.names:
        kernel.write(record, name, values[name])
    launch(kernel.kernel, count, [record], like, threads, work)
