"""Reading files that strangers made.

Only what lies on a disk is opened, arrays are of numbers and of no more than memory holds, and
whatever a decoder stumbles on becomes one line.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from ddrecon.errors import DdreconError, FormatError, is_utf8

if TYPE_CHECKING:
    import numpy as np

MAX_BYTES = 4 * 2**30
"""More than this, uncompressed, is taken for a mistake or an attack."""


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
        if not is_utf8(path):
            raise FormatError(path, "cannot be read: its name is not UTF-8; rename it") from error
        raise FormatError(path, f"is damaged: {error or type(error).__name__}") from error


def require_stored(path: Path) -> None:
    """Raises FormatError where `path` is a pipe, a device or a socket; OSError where it is not.

    These might never end or never answer.
    """
    kind = stat.S_IFMT(os.stat(path).st_mode)
    if kind not in (stat.S_IFREG, stat.S_IFDIR):
        raise FormatError(path, "is a pipe, a device or a socket; only regular files are read")


def read_json(path: Path) -> Any:
    """What the JSON file at `path` says; raises FormatError."""
    with guard_reading(path):
        try:
            return json.loads(path.read_bytes())
        except (ValueError, RecursionError) as error:
            raise FormatError(path, f"not JSON: {error}") from error


def read_npy(stream: IO[bytes], size: int, path: Path, name: str) -> np.ndarray:
    """The array of real numbers in `stream`, which holds `size` bytes of .npy.

    `path` and `name` are what errors speak of. Raises FormatError for arrays of objects or
    text, over 4 GiB, or shorter or longer than their header says.
    """
    from numpy.lib import format as npy  # here, as scene files are read without NumPy

    check_size(size, path, name)
    try:
        values: np.ndarray = npy.read_array(stream, allow_pickle=False)
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
    import numpy as np

    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, dtype=np.float32)
