"""Fused kernels are compiled for graphics cards where there are none as well."""

import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ARCHITECTURES = 80, 90, 120
"""Of cards of three generations (sm_80 and so on): no kernel's text depends on which it is."""
INFO = 0x70000000
"""Type of the sections of an ELF file that say what a function needs."""


def assert_compiles(kernels: Sequence[Any], folder: Path) -> None:
    """Asserts that each of `kernels` compiles, into `folder`, for the oldest of them."""
    import warp as wp

    oldest = ARCHITECTURES[0]
    for kernel in kernels:
        wp.compile_aot_module(kernel.module, arch=oldest, use_ptx=True, module_dir=folder)
    assert len(list(folder.glob(f"*.sm{oldest}.ptx"))) == len(kernels)


def find_resources(kernel: Any, architecture: int, folder: Path) -> tuple[int, int]:
    """Registers of a thread and bytes of its stack, of a Warp `kernel` compiled into `folder`.

    They stand in a cubin's sections of type `INFO`: a format (4: with a size), an attribute (0x2f:
    registers; 0x11: the stack's frame), a size of 8 bytes, then which function's and how many.
    """
    import warp as wp

    (path,) = wp.compile_aot_module(
        kernel.module, arch=architecture, use_ptx=False, module_dir=folder
    )
    code = path.read_bytes()
    (table,), (width, count) = (
        struct.unpack_from("<Q", code, 40),
        struct.unpack_from("<2H", code, 58),
    )
    headers = (struct.unpack_from("<2I4Q", code, table + width * k) for k in range(count))
    info = b"".join(code[at : at + size] for _, kind, _, _, at, size in headers if kind == INFO)
    found = (
        re.findall(b"\x04" + one + b"\x08\0.{4}(.{4})", info, re.S) for one in (b"\x2f", b"\x11")
    )
    registers, stack = (max(int.from_bytes(each, "little") for each in many) for many in found)
    return registers, stack
