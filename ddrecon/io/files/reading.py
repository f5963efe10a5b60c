"""Reading files that strangers made.

Only what lies on a disk is opened, and whatever a decoder stumbles on becomes one line.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ddrecon.errors import DdreconError, FormatError, is_utf8


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
