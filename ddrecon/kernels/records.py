"""Kernels that are given one record: the addresses of arrays, and whole numbers, by name.

The text of such a kernel names each array once, where the record is declared; making Warp's own
arrays takes longer than handing over their addresses.
"""

import functools
from collections.abc import Mapping
from typing import Any

import warp as wp
from torch import Tensor, is_tensor

from ddrecon.kernels.launch import launch
from ddrecon.kernels.native import number_type, program

_TYPES = {"real": "F", "whole": "int", "long": "long long", "double": "double"}


@functools.cache
def record_kernel(name: str, bits: int, text: str, arrays: str, numbers: str = "") -> Any:
    """The kernel `name` that does `text`, C++ as of `program`, for each `item`.

    The text has pointers called as the `arrays`, of numbers `F` or, where it says so
    (`whole:items long:addresses double:sums`), of whole ones or of double precision; and whole
    `numbers`.
    """
    types = dict(
        (one.partition(":")[::-2] if ":" in one else (one, "real")) for one in arrays.split()
    )
    fields = dict.fromkeys(types, wp.uint64) | dict.fromkeys(numbers.split(), int)
    Record = wp.struct(type("Record", (), {"__annotations__": fields, "__module__": __name__}))
    given = [f"{_TYPES[t]}* const {one} = ({_TYPES[t]}*)record.{one};" for one, t in types.items()]
    given += [f"const int {one} = record.{one};" for one in numbers.split()]

    @wp.func_native(program(bits, "\n".join(given) + text))
    def do_item(item: int, record: Record): ...

    @wp.kernel(enable_backward=False, module="unique", name=name)
    def do_items(first: int, record: Record):
        do_item(first + wp.tid(), record)

    do_items.Record, do_items.names = Record, tuple(fields)
    return do_items


def launch_record(
    kernel: Any,
    count: int,
    values: Mapping[str, Tensor | int],
    like: Tensor,
    threads: int | None = None,
    work: int | None = None,
) -> None:
    """Runs `kernel` for `count` items of contiguous arrays and numbers, `values` by name.

    `threads` and `work` as of `launch`.
    """
    record = kernel.Record()
    for name in kernel.names:
        value = values[name]
        if is_tensor(value) and not value.is_contiguous():
            raise ValueError("arrays that kernels are given are contiguous")
        setattr(record, name, value.data_ptr() if is_tensor(value) else value)
    launch(kernel, count, [record], like, threads, work)
