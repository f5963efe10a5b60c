"""Arrays in files that strangers made: of numbers, and of no more than memory holds."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from ddrecon.errors import FormatError

MAX_BYTES = 4 * 2**30
"""More than this, uncompressed, is taken for a mistake or an attack."""


def read_npy(stream: IO[bytes], size: int, path: Path, name: str) -> np.ndarray:
    """The array of real numbers in `stream`, which holds `size` bytes of .npy.

    `path` and `name` are what errors speak of. Raises FormatError for arrays of objects or
    text, over 4 GiB, or shorter or longer than their header says.
    """
    check_size(size, path, name)
    try:
        values = npy.read_array(stream, allow_pickle=False)
        if stream.read(1):
            raise ValueError("it holds more than its header says")
    except (ValueError, SyntaxError, TypeError, EOFError) as error:
        raise FormatError(path, f"{name} is damaged, or not NumPy data: {error}") from error
    if values.dtype.kind not in "fiub":
        raise FormatError(path, f"{name} holds values of type {values.dtype}; save it as float32")
    return values


def check_size(size: int, path: Path, name: str) -> None:
    """Raises FormatError when `size` [bytes] is more than `MAX_BYTES`."""
    if size > MAX_BYTES:
        most = f"at most {MAX_BYTES // 2**30} GiB are read"
        raise FormatError(path, f"{name} takes {size / 2**30:.1f} GiB uncompressed; {most}")


def as_float32(values: np.ndarray) -> np.ndarray:
    """`values` as contiguous float32; those beyond its range are infinite, which callers refuse."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, dtype=np.float32)
