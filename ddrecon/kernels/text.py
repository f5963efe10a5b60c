"""Kernels whose items do a text in C++, which has its arguments by name.

    text = "out[item] = factor * x[item];"
    scale = TextKernel("scale", bits, text, "F *x, *out; F factor", "out")
    scale.launch(count, {"x": x, "factor": 2.0}, {"out": out})

Warp's own language makes scalar code of a thread. C++ it compiles for processors, where loops over
numbers beside each other become vector instructions, and for GPUs, where a thread does one turn.
What is more than a call stands in a `header` of the package, in the namespace `ddrecon`: at least
`numbers.h` and `packets.h` can be called.

Arguments are declared as in C: pointers and numbers of type `F` (the kernel's own), `double`,
`int`, `long` or `bool`; `F *fields[3]` are three pointers. Pointers that are no outputs are to
constants. All arguments go into one record: a launch takes the same few microseconds, however many
they are.
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
PACKAGE = Path(__file__).parents[1]
_PACKETS = (PACKAGE / "kernels/packets.h").read_text(encoding="utf-8")
LANES = int(re.findall(r"LANES = (\d+);", _PACKETS)[-1])
"""Items in a packet on a processor (`packets.h`)."""
MOST_REGISTERS = 128
"""Of a thread on a GPU: two blocks of 256 threads then have room beside each other."""
_INCLUDE = re.compile(r'#include "ddrecon/(.*)"')


class TextKernel:
    """The kernel `name` that does `text` for each `item`, in numbers of so many `bits`.

    `declared` says what the text has besides, and `outputs` names the arrays of that which it
    writes, whether it reads them or not.
    """

    def __init__(
        self,
        name: str,
        bits: int,
        text: str,
        declared: str,
        outputs: str,
        header: str = "kernels/packets.h",
    ):
        F = wp.float64 if bits == 64 else wp.float32
        types = _TYPES | {"F": ("F", F, torch.float64 if bits == 64 else torch.float32)}
        members, variables = dict[str, Any](), list[str]()
        self.arrays: dict[str, torch.dtype] = {}
        self.lists: dict[str, list[str]] = {}
        self.written = set(outputs.split())
        for word, is_array, variable, count in declarations(declared):
            c_type, number, dtype = types[word]
            entries = [f"{variable}_{k}" for k in range(count)] or [variable]
            # Pointers go as numbers: their addresses.
            members |= dict.fromkeys(entries, wp.uint64 if is_array else number)
            if is_array:
                c_type = f"{c_type}*" if variable in self.written else f"const {c_type}*"
                self.arrays |= dict.fromkeys(entries, dtype)
            values = ", ".join(f"({c_type})record.{entry}" for entry in entries)
            if count:
                self.lists[variable] = entries
                variables.append(f"{c_type} const {variable}[] = {{{values}}};\n")
            else:
                variables.append(f"{c_type} const {variable} = {values};\n")
        Record = wp.struct(type("Record", (), {"__annotations__": members, "__module__": __name__}))

        begin = f"using namespace ddrecon;\ntypedef {'double' if bits == 64 else 'float'} F;\n"
        options = {"extra_build_options": include(header)}

        @wp.func_native(begin + "".join(variables) + text)
        def do_item(item: int, record: Record): ...

        @wp.kernel(
            enable_backward=False,
            module="unique",
            name=name,
            module_options=options,
            cuda_max_registers=MOST_REGISTERS,
        )
        def do_items(first: int, record: Record):
            do_item(first + wp.tid(), record)

        self.name, self.names = name, set(members)
        self.kernel, self.module = do_items, do_items.module
        # Warp's own records check each value that they are given, which takes longer than the rest.
        plain = type(Record().__ctype__())
        self.new_record: Any = type("Record", (plain,), {"__ctype__": lambda self: self})

    def launch(
        self,
        count: int,
        inputs: Mapping[str, Any],
        outputs: Mapping[str, Any],
        threads: int | None = None,
        shares: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """Does `count` items with arrays and numbers `inputs`, and writes to arrays `outputs`.

        Outputs are contiguous. With `shares` a thread writes to the outputs in its own of these.
        """
        bound = self.bind(inputs, outputs)
        if not shares:
            bound.launch(count, threads)
            return
        records = [self.new_record.from_buffer_copy(bound.record) for _ in shares]
        for record, share in zip(records, shares, strict=True):
            assert share.keys() <= self.written, share.keys() - self.written
            self._write_all(record, share)
        launch(self.kernel, count, records, bound.arrays[0], len(records))

    def bind(self, inputs: Mapping[str, Any], outputs: Mapping[str, Any]) -> "Bound":
        """The kernel with all that `launch` is given, for many launches.

        Raises ValueError for an array that it writes and that is not among `outputs`: of a copy of
        that nobody would see what is written. And for one that is, and that it does not write.
        """
        if wrong := (self.written & inputs.keys()) | (outputs.keys() - self.written):
            raise ValueError(
                f"{self.name} writes {self.written}: {wrong} are handed over as others"
            )
        record = self.new_record()
        arrays = self._write_all(record, inputs) + self._write_all(record, outputs)
        return Bound(self, record, arrays)

    def _write_all(self, record: Any, values: Mapping[str, Any]) -> list[Tensor]:
        """Writes `values` by their names, lists of them as well; returns the arrays among them."""
        arrays = list[Tensor]()
        for name, value in values.items():
            is_list = name in self.lists
            entries = zip(self.lists[name], value, strict=True) if is_list else ((name, value),)
            for entry, number in entries:
                if isinstance(number, Tensor):
                    if name not in self.written:
                        # Also where both fit: what torch.func has wrapped is unwrapped so.
                        number = number.to(self.arrays.get(entry)).contiguous()
                    arrays.append(number)
                self.write(record, entry, number)
        return arrays

    def write(self, record: Any, name: str, value: Any) -> None:
        """Writes a number into `record`, or the address of an array; 0 of one that is None."""
        if isinstance(value, Tensor):
            expected = self.arrays.get(name)
            if value.dtype is not expected or not value.is_contiguous():
                raise ValueError(f"{name} is declared as {expected}, and is to be contiguous")
            setattr(record, name, value.data_ptr())
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

    By texts, not paths, a kernel is the same wherever the package lies.
    """
    text, texts = (PACKAGE / header).read_text(encoding="utf-8"), {}
    for included in _INCLUDE.findall(text):
        texts |= _texts(included)
    text = _INCLUDE.sub("", text.removeprefix("#pragma once"))
    return texts | {header: f'#line 1 "ddrecon/{header}"\n{text}'}


@dataclass(frozen=True)
class Bound:
    """A kernel with its `record`; `arrays` is what this points to."""

    kernel: TextKernel
    record: Any
    arrays: list[Tensor]

    def launch(self, count: int, threads: int | None = None, **changed: Any) -> None:
        """Does `count` items, with numbers and contiguous arrays `changed`."""
        for name, value in changed.items():
            self.kernel.write(self.record, name, value)
        launch(self.kernel.kernel, count, [self.record], self.arrays[0], threads)


def declarations(declared: str) -> Iterator[tuple[str, bool, str, int]]:
    """Of each name: its type's word, whether it is an array, of how many in a list (0: none)."""
    for declaration in filter(str.strip, declared.split(";")):
        word, names = declaration.split(maxsplit=1)
        for name in names.split(","):
            star, variable, count = re.fullmatch(r"(\*?)(\w+)(?:\[(\d+)\])?", name.strip()).groups()
            yield word, bool(star), variable, int(count or 0)


@functools.cache
def members_of(header: str, struct: str) -> str:
    """What a `struct` of a `header` holds before its functions, as kernels declare it.

    Without lists of pointers: how many there are, a kernel says.
    """
    text = (PACKAGE / header).read_text(encoding="utf-8")
    (members,) = re.findall(rf"struct {struct} {{\n((?:    [^/(]*?;\n)+)", text)
    members = re.sub(r".*\* const\*.*\n|const |\n", "", members).replace("* ", " *")
    return re.sub("long long|Size", "long", members)


def names_of(declared: str) -> str:
    """The names that are `declared`, in order: arguments of a function, or a record of C++."""
    return ", ".join(name for _, _, name, _ in declarations(declared))


def cut(total: int, length: int, like: Tensor) -> tuple[int, int]:
    """Items that do `total` numbers, and how many each: `length`, or one on a GPU."""
    length = 1 if like.is_cuda else length
    return -(-total // length), length
