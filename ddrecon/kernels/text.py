"""Kernels whose items do a text in C++, which finds all it is given by name.

    text = "out[item] = factor * x[item];"
    scale = TextKernel("scale", bits, text, "F *x, *out; F factor", "out")
    scale.launch(count, {"x": x, "factor": 2.0}, {"out": out})

Warp's own language makes scalar code of a thread. C++ it compiles for processors, where loops over
numbers beside each other become vector instructions, and for GPUs, where a thread does one turn.
What is more than a call stands in a `header` of the package, in the namespace `ddrecon`: at least
`numbers.h` and `packets.h` can be called.

What the text is given is declared as in C: pointers and numbers of type `F` (the kernel's own),
`double`, `int`, `long` or `bool`; `F *fields[3]` are three pointers. Those that are named as made
it writes; others point to constants. It all goes into one record: a launch takes the same few
microseconds, however much that is.
"""

import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import warp as wp
from torch import Tensor

from ddrecon.kernels.launch import MOST, launch, too_many

_TYPES = {
    "double": ("double", wp.float64, torch.float64),
    "int": ("int", wp.int32, torch.int32),
    "long": ("long long", wp.int64, torch.int64),
    "bool": ("bool", wp.bool, torch.bool),
}
_PACKETS = Path(__file__).with_name("packets.h").read_text(encoding="utf-8")
LANES = int(re.findall(r"LANES = (\d+);", _PACKETS)[-1])
"""Items in a packet on a processor (`packets.h`)."""
_INCLUDE = re.compile(r'#include "ddrecon/(.*)"')


class TextKernel:
    """The kernel `name` that does `text` for each `item`, in numbers of so many `bits`.

    `given` declares what the text has besides, and `made` names the arrays of that which it writes,
    whether it reads them or not.
    """

    def __init__(
        self,
        name: str,
        bits: int,
        text: str,
        given: str,
        made: str,
        header: str = "kernels/packets.h",
    ):
        F = wp.float64 if bits == 64 else wp.float32
        types = _TYPES | {"F": ("F", F, torch.float64 if bits == 64 else torch.float32)}
        members, locals_, self.arrays = {}, [], {}
        self.lists: dict[str, list[str]] = {}
        self.made = set(made.split())
        for word, is_array, one, count in declarations(given):
            written, number, dtype = types[word]
            entries = [f"{one}_{k}" for k in range(count)] or [one]
            members |= dict.fromkeys(entries, wp.uint64 if is_array else number)
            if is_array:
                written = f"{written}*" if one in self.made else f"const {written}*"
                self.arrays |= dict.fromkeys(entries, dtype)
            casts = ", ".join(f"({written})given.{entry}" for entry in entries)
            if count:
                self.lists[one] = entries
                locals_.append(f"{written} const {one}[] = {{{casts}}};\n")
            else:
                locals_.append(f"{written} const {one} = {casts};\n")
        # Pointers go as numbers: their addresses.
        Record = wp.struct(type("Record", (), {"__annotations__": members, "__module__": __name__}))

        number = f"using namespace ddrecon;\ntypedef {'double' if bits == 64 else 'float'} F;\n"
        options = {"extra_build_options": include(header)}

        @wp.func_native(number + "".join(locals_) + text)
        def do_item(item: int, given: Record): ...

        @wp.kernel(enable_backward=False, module="unique", name=name, module_options=options)
        def do_items(first: int, given: Record):
            do_item(first + wp.tid(), given)

        self.name, self.bits, self.text, self.given = name, bits, text, given
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
    ) -> None:
        """Does `count` items with arrays and numbers `given`, and writes to arrays `made`.

        Those that are made are contiguous. A thread has what is in its own of `shares` as well.
        """
        bound = self.bind(given, made)
        if not shares:
            bound.launch(count, threads)
            return
        own = [self.new_record.from_buffer_copy(bound.record) for _ in shares]
        for record, share in zip(own, shares, strict=True):
            for name, value in share.items():
                assert name in self.made, name
                self.write(record, name, value)
        launch(self.kernel, count, lambda i: [own[i]], bound.like, len(own))

    def bind(self, given: Mapping[str, Any], made: Mapping[str, Any]) -> "Bound":
        """The kernel with all that `launch` is given, for many launches.

        Raises ValueError for an array that it writes and that is not `made`: of a copy of that
        nobody would see what is written. And for one that is, and that it does not write.
        """
        record, kept = self.new_record(), []
        if wrong := (self.made & given.keys()) | (made.keys() - self.made):
            raise ValueError(f"{self.name} writes {self.made}: {wrong} are handed over as others")
        for name, value in given.items():
            if name in self.lists:
                value = [self._ready(*each) for each in zip(self.lists[name], value, strict=True)]
            else:
                value = self._ready(name, value)
            self.write(record, name, value)
            kept.append(value)
        for name, value in made.items():
            self.write(record, name, value)
        lists = (value if isinstance(value, list) else [value] for value in made.values())
        arrays = [array for each in lists for array in each if isinstance(array, Tensor)]
        return Bound(self, record, [kept, made], arrays[0])

    def _ready(self, name: str, value: Any) -> Any:
        is_array = isinstance(value, Tensor)
        return value.to(self.arrays.get(name)).contiguous() if is_array else value

    def write(self, record: Any, name: str, value: Any) -> None:
        """Writes a number into `record`, or the address of an array; 0 of one that is None."""
        if isinstance(value, Tensor):
            expected = self.arrays.get(name)
            if value.dtype is not expected or not value.is_contiguous():
                raise ValueError(f"{name} is declared as {expected}, and is to be contiguous")
            setattr(record, name, value.data_ptr())
        elif name in self.lists:
            for entry, each in zip(self.lists[name], value, strict=True):
                self.write(record, entry, each)
        elif name in self.names:
            setattr(record, name, 0 if value is None else value)
            if isinstance(value, int) and value >= MOST and getattr(record, name) != value:
                raise too_many(f"{self.name}, {name}", value)
        else:
            raise ValueError(f"the kernel declares no {name}")


def include(header: str) -> Any:
    """Warp's options for modules that include a `header` of the package, by its path in there.

    They are experimental in Warp 1.19, and named here alone.
    """
    text = "".join(_texts(header).values())
    return wp.ModuleBuildOptions(extra_cpu_preamble=text, extra_cuda_preamble=text)


@functools.cache
def _texts(header: str) -> dict[str, str]:
    """The text of a `header` after those of what it includes, by path.

    Given by text, not by path, a kernel is the same wherever the package lies.
    """
    text, found = (Path(__file__).parents[1] / header).read_text(encoding="utf-8"), {}
    for included in _INCLUDE.findall(text):
        found |= _texts(included)
    text = _INCLUDE.sub("", text.removeprefix("#pragma once"))
    return found | {header: f'#line 1 "ddrecon/{header}"\n{text}'}


@dataclass(frozen=True)
class Bound:
    """A kernel with the `record` it is given; `kept` is what this points to."""

    kernel: TextKernel
    record: Any
    kept: Any
    like: Tensor

    def launch(self, count: int, threads: int | None = None, **changed: Any) -> None:
        """Does `count` items, with numbers and contiguous arrays `changed`."""
        for name, value in changed.items():
            self.kernel.write(self.record, name, value)
        launch(self.kernel.kernel, count, [self.record], self.like, threads)


def declarations(given: str) -> Iterator[tuple[str, bool, str, int]]:
    """Of each name: its type's word, whether it is an array, of how many in a list (0: none)."""
    for declaration in filter(str.strip, given.split(";")):
        word, names = declaration.split(maxsplit=1)
        for name in names.split(","):
            star, one, count = re.fullmatch(r"(\*?)(\w+)(?:\[(\d+)\])?", name.strip()).groups()
            yield word, bool(star), one, int(count or 0)


def names_of(given: str) -> str:
    """The names that `given` declares, in order: arguments of a function, or a record of C++."""
    return ", ".join(name for _, _, name, _ in declarations(given))


def cut(total: int, length: int, like: Tensor) -> tuple[int, int]:
    """Items that do `total` numbers, and how many each: `length`, or one on a GPU."""
    length = 1 if like.is_cuda else length
    return -(-total // length), length
