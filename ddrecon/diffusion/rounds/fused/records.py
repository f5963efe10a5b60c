"""Kernels whose headers name all they are given: structs in C++, which Python fills by name."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ddrecon.kernels.text import TextKernel, declarations

_ROOM = "diffusion/rounds/fused"


def struct_kernel(name: str, bits: int, header: str, struct: str, function: str) -> TextKernel:
    """The kernel of a `function(item, given)` in a `header` of this room.

    It is given what a `struct` of `given.h` declares, and writes where pointers are not const.
    """
    body = _read(struct)
    made = [each for each in body.split(";") if "*" in each and "const" not in each]
    given = body.replace("const ", "")
    values = [
        f"{{{', '.join(f'{one}[{k}]' for k in range(count))}}}" if count else one
        for _, _, one, count in declarations(given)
    ]
    text = f"{function}(item, {struct}<F>{{{', '.join(values)}}});"
    written = " ".join(one for _, _, one, _ in declarations(";".join(made)))
    return TextKernel(name, bits, text, given, written, f"{_ROOM}/{header}")


def table(struct: str, rows: Iterable[Mapping[str, Any]]) -> Tensor:
    """A `struct` of `given.h` for each of `rows`, whole numbers, which have its fields by name."""
    names = re.findall(r"(\w+)(?:\[\d\])*[,;]", _read(struct))
    numbers = [[torch.tensor(row[name]).flatten() for name in names] for row in rows]
    return torch.stack([torch.cat(row) for row in numbers]).int()


def _read(struct: str) -> str:
    """What a `struct` declares."""
    text = Path(__file__).with_name("given.h").read_text(encoding="utf-8")
    (body,) = re.findall(rf"struct {struct} {{(.*?)\n}};", text, re.DOTALL)
    return " ".join(body.replace("* ", " *").split())
