"""Fused kernels are compiled for graphics cards where there are none as well.

What iterations launch is compiled by `test_graphics_cards.py`; tests of a header add what it has
besides. No two kernels begin with the same text, so compiling headers ahead takes longer.
"""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

ARCHITECTURES = 80, 90, 120
"""Of cards of three generations (sm_80 and so on): no kernel's text depends on which it is."""
INFO, SIZED, REGISTERS, STACK = 0x70000000, 4, 0x2F, 0x11
"""Of an ELF file for graphics cards: a type of sections, a format and two attributes in these."""


def assert_compiles(kernels: Sequence[Any], folder: Path) -> None:
    """Asserts that each of `kernels` compiles, into `folder`, for the oldest of them."""
    oldest = ARCHITECTURES[0]
    for kernel in kernels:
        _compile(kernel, arch=oldest, use_ptx=True, module_dir=folder)
    assert len(list(folder.glob(f"*.sm{oldest}.ptx"))) == len(kernels)


def find_resources(kernel: Any, architecture: int, folder: Path) -> tuple[int, int]:
    """Registers of a thread and bytes of its stack, of a Warp `kernel` compiled into `folder`."""
    (path,) = _compile(kernel, arch=architecture, use_ptx=False, module_dir=folder)
    most = {REGISTERS: 0, STACK: 0}
    for attribute, value in _attributes(path.read_bytes()):
        if attribute in most:
            most[attribute] = max(most[attribute], struct.unpack("<2I", value)[1])
    return most[REGISTERS], most[STACK]


def _compile(kernel: Any, **how: Any) -> list[Path]:
    import warp as wp

    with patch.object(wp.config, "use_precompiled_headers", False):
        return wp.compile_aot_module(kernel.module, **how)


def _attributes(code: bytes) -> Iterator[tuple[int, bytes]]:
    """What the sections of type `INFO` of a cubin, which is an ELF file, say of its functions.

    An entry is a format and an attribute of a byte each, then two bytes: its value, or of format
    `SIZED` the length of the value behind them. Those of functions are a number of the function
    and one of what it needs.
    """
    (table,), (width, count) = (
        struct.unpack_from("<Q", code, 40),
        struct.unpack_from("<2H", code, 58),
    )
    for section in range(count):
        _, kind, _, _, at, size = struct.unpack_from("<2I4Q", code, table + width * section)
        end = at + size if kind == INFO else at
        while at < end:
            form, attribute, length = struct.unpack_from("<2BH", code, at)
            length = length if form == SIZED else 0
            yield attribute, code[at + 4 : at + 4 + length]
            at += 4 + length
