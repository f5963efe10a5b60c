"""Arrays in files that strangers made: of numbers, and of no more than memory holds."""

from __future__ import annotations

import math
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
        version = npy.read_magic(stream)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = read(stream)
    except (ValueError, SyntaxError, TypeError, EOFError) as error:
        raise FormatError(path, f"{name} is not NumPy data: {error}") from error
    if dtype.kind not in "fiub":
        kind = "Python objects" if dtype.hasobject else f"values of type {dtype}"
        raise FormatError(path, f"{name} holds {kind}; save it as float32")
    if math.prod(shape) * dtype.itemsize != size - stream.tell():
        text = f"its header says {list(shape)} of {dtype}, which is not the size of its data"
        raise FormatError(path, f"{name} is damaged: {text}")
    stream.seek(0)
    return npy.read_array(stream, allow_pickle=False)


def check_size(size: int, path: Path, name: str) -> None:
    """Raises FormatError when `size` [bytes] is more than `MAX_BYTES`."""
    if size > MAX_BYTES:
        most = f"at most {MAX_BYTES // 2**30} GiB are read"
        raise FormatError(path, f"{name} takes {size / 2**30:.1f} GiB uncompressed; {most}")


def as_float32(values: np.ndarray) -> np.ndarray:
    """`values` as contiguous float32; those beyond its range are infinite, which callers refuse."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, dtype=np.float32)
