"""Kernels whose items do a text in C++, which finds all it is given by name.

    scale = TextKernel("scale", bits, "out[item] = factor * x[item];", "F *x, *out; F factor")
    scale.launch(count, {"x": x, "factor": 2.0}, {"out": out})

What the text is given is declared as in C: pointers and numbers of type `F` (the kernel's own),
`double`, `int`, `long` or `bool`; `F *fields[3]` are three pointers. It all goes into one record:
a launch takes the same few microseconds, however much that is.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor, is_tensor

from ddrecon.kernels.launch import launch
from ddrecon.kernels.native import number_type, program

_TYPES = {
    "double": ("double", wp.float64, torch.float64),
    "int": ("int", wp.int32, torch.int32),
    "long": ("long long", wp.int64, torch.int64),
    "bool": ("bool", wp.bool, torch.bool),
}
BLOCK = """
const int begin = item * length, end = begin + length < total ? begin + length : total;
"""
"""Before a text: its item does the numbers `begin` to `end` of a `total`, `length` of them."""


class TextKernel:
    """The kernel `name` that does `text` for each `item`, in numbers of so many `bits`.

    `given` declares what the text has besides; `write` puts before it what both need.
    """

    def __init__(
        self,
        name: str,
        bits: int,
        text: str,
        given: str,
        write: Callable[[int, str], str] = program,
    ):
        F = number_type(bits)
        types = _TYPES | {"F": ("F", F, torch.float64 if bits == 64 else torch.float32)}
        members, locals_, self.arrays = {}, [], {}
        self.lists: dict[str, list[str]] = {}
        for word, is_array, one, count in _declared(given):
            written, number, dtype = types[word]
            entries = [f"{one}_{k}" for k in range(count)] or [one]
            members |= dict.fromkeys(entries, wp.uint64 if is_array else number)
            if is_array:
                written += "*"
                self.arrays |= dict.fromkeys(entries, dtype)
            casts = ", ".join(f"({written})given.{entry}" for entry in entries)
            if count:
                self.lists[one] = entries
                locals_.append(f"{written} const {one}[] = {{{casts}}};\n")
            else:
                locals_.append(f"{written} const {one} = {casts};\n")
        # Pointers go as numbers: their addresses.
        Record = wp.struct(type("Record", (), {"__annotations__": members, "__module__": __name__}))

        @wp.func_native(write(bits, "".join(locals_) + text))
        def do_item(item: int, given: Record): ...

        @wp.kernel(enable_backward=False, module="unique", name=name)
        def do_items(first: int, given: Record):
            do_item(first + wp.tid(), given)

        self.names, self.kernel, self.module = set(members), do_items, do_items.module
        # Warp's own records check each value that they are given, which takes longer than the rest.
        plain = type(Record().__ctype__())
        self.new_record: Any = type("Record", (plain,), {"__ctype__": lambda self: self})

    def launch(
        self,
        count: int,
        given: Mapping[str, Any],
        made: Mapping[str, Any],
        threads: int | None = None,
        shares: Sequence[Mapping[str, Any]] = (),
        work: int | None = None,
    ) -> None:
        """Does `count` items with arrays and numbers `given`, and writes to arrays `made`.

        Those that are made are contiguous. A thread has what is in its own of `shares` as well.
        `work` as of `launch.launch`.
        """
        bound = self.bind(given, made)
        if not shares:
            bound.launch(count, threads, work)
            return
        own = []
        for share in shares:
            own.append(self.new_record.from_buffer_copy(bound.record))
            self.fill(own[-1], dict(self._entries(share)))
        launch(self.kernel, count, lambda i: [own[i]], bound.like, len(own))

    def bind(self, given: Mapping[str, Any], made: Mapping[str, Any]) -> "Bound":
        """The kernel with all that `launch` is given, for many launches."""
        held = {name: self._ready(name, value) for name, value in self._entries(given)}
        held |= dict(self._entries(made))
        record = self.new_record()
        self.fill(record, held)
        return Bound(self, record, held, next(each for each in made.values() if is_tensor(each)))

    def _entries(self, values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        """Names and values, those of lists one by one."""
        for name, value in values.items():
            if name in self.lists:
                yield from zip(self.lists[name], value, strict=True)
            else:
                yield name, value

    def _ready(self, name: str, value: Any) -> Any:
        """A value as the text reads it; what is kept of it, its address is valid with."""
        return value.to(self.arrays[name]).contiguous() if is_tensor(value) else value

    def fill(self, record: Any, values: Mapping[str, Any]) -> None:
        """Writes numbers into `record`, and addresses of arrays; 0 of those that are None."""
        for name, value in values.items():
            if name not in self.names:
                raise ValueError(f"the kernel declares no {name}")
            if is_tensor(value):
                if value.dtype != self.arrays[name] or not value.is_contiguous():
                    raise ValueError(f"{name} is to be contiguous, of type {self.arrays[name]}")
                value = value.data_ptr()
            setattr(record, name, 0 if value is None else value)


@dataclass(frozen=True)
class Bound:
    """A kernel with the `record` it is given, and what this points to."""

    kernel: TextKernel
    record: Any
    held: Mapping[str, Any]
    like: Tensor

    def launch(
        self, count: int, threads: int | None = None, work: int | None = None, **numbers: float
    ) -> None:
        """Does `count` items, with these `numbers` changed."""
        self.kernel.fill(self.record, numbers)
        launch(self.kernel.kernel, count, [self.record], self.like, threads, work)


def _declared(given: str) -> Iterator[tuple[str, bool, str, int]]:
    """Of each name declared: the word for its type, whether it is an array, of how many in a list.

    0 is no list.
    """
    for declaration in filter(str.strip, given.split(";")):
        word, names = declaration.split(maxsplit=1)
        for name in names.split(","):
            star, one, count = re.fullmatch(r"(\*?)(\w+)(?:\[(\d+)\])?", name.strip()).groups()
            yield word, bool(star), one, int(count or 0)


def cut(total: int, length: int, like: Tensor) -> tuple[int, int]:
    """Items that do `total` numbers, and how many each: `length`, or one on a GPU."""
    length = 1 if like.is_cuda else length
    return -(-total // length), length
