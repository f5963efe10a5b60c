"""Reading files that strangers made.

Only what lies on a disk is opened, and whatever a decoder stumbles on becomes one line.
"""

from __future__ import annotations

import math
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from ddrecon.errors import DdreconError, FormatError


@contextmanager
def guard_reading(path: Path) -> Iterator[None]:
    """Any error of the block, which reads the file or folder at `path`, becomes a FormatError.

    Raises FormatError, before the block, for what is neither: a pipe or a device is never opened.
    """
    try:
        require_stored(path)
        yield
    except DdreconError:
        raise
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise FormatError(path, "cannot be read: not enough memory") from error
    except Exception as error:  # decoders of damaged files raise whatever they like
        raise FormatError(path, f"is damaged: {error or type(error).__name__}") from error


def require_stored(path: Path) -> None:
    """Raises FormatError where `path` is a pipe, a device or a socket; OSError where it is not.

    These might never end or never answer.
    """
    kind = stat.S_IFMT(os.stat(path).st_mode)
    if kind not in (stat.S_IFREG, stat.S_IFDIR):
        raise FormatError(path, "is a pipe, a device or a socket; only regular files are read")


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
        told = f"its header says {list(shape)} of {dtype}, which is not the size of its data"
        raise FormatError(path, f"{name} is damaged: {told}")
    stream.seek(0)
    return npy.read_array(stream, allow_pickle=False)


def check_size(size: int, path: Path, name: str) -> None:
    """Raises FormatError when `size` [bytes] is more than `MAX_BYTES`."""
    if size > MAX_BYTES:
        most = f"at most {MAX_BYTES // 2**30} GiB are read"
        raise FormatError(path, f"{name} takes {size / 2**30:.1f} GiB uncompressed; {most}")


def as_float32(values: np.ndarray) -> np.ndarray:
    """`values` as contiguous float32.

    Numbers beyond its range become infinite, which callers refuse.
    """
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, dtype=np.float32)
