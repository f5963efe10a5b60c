"""Fused kernels are compiled for graphics cards where there are none as well."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

ARCHITECTURE = 80
"""Of the oldest cards that are tried: no kernel's text depends on it."""


def assert_compiles(kernels: Sequence[Any], folder: Path) -> None:
    """Asserts that each of `kernels` compiles, into `folder`."""
    import warp as wp

    for kernel in kernels:
        wp.compile_aot_module(kernel.module, arch=ARCHITECTURE, use_ptx=True, module_dir=folder)
    assert len(list(folder.glob(f"*.sm{ARCHITECTURE}.ptx"))) == len(kernels)
