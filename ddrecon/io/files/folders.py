"""Output folders and files: nothing is overwritten unasked, and one process at a time writes.

The operating system locks a file that names its holder, and lets go when its process ends, however
it ends, so what a killed process left behind is only a name.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from ddrecon.errors import UsageError

LOCK = "ddrecon.lock"
"""The name of the lock file."""


@contextmanager
def claim_folder(path: Path, *, may_exist: bool) -> Iterator[None]:
    """Makes the folder `path`, and keeps other processes out of it until the block ends.

    Raises UsageError where it is a file or cannot be locked, where another process writes there, or
    where it holds something and `may_exist` is False.
    """
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: is a file; name a folder for the output")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: cannot be made: {error.strerror or error}") from error
    lock = path / LOCK
    try:
        # No soft locks: what they leave behind would have to be judged stale or not.
        own = FileLock(lock, fallback_to_soft=False).acquire(timeout=0)
    except Timeout:
        holder = ""
        with suppress(OSError):  # it may be gone by now; some releases of filelock empty it
            holder = lock.read_text()
        process = f"process {holder}" if holder.isdigit() else "another process"
        raise UsageError(
            f"{path}: {process} is writing there; wait for it, or choose another folder"
        ) from None
    except OSError as error:
        raise UsageError(f"{lock}: cannot be locked: {error.strerror or error}") from error
    with own:
        lock.write_text(str(os.getpid()))
        try:
            if not may_exist and any(entry != lock for entry in path.iterdir()):
                raise UsageError(
                    f"{path}: the folder is not empty; choose another, or say --overwrite"
                )
            yield
        finally:
            # Before the lock goes: whoever waits for a file without a name has to begin again.
            lock.unlink(missing_ok=True)


def require_free_files(paths: Sequence[Path], *, may_exist: bool) -> None:
    """Raises UsageError unless `paths` can be written: their folders exist, and they do not.

    With `may_exist` only the folders must.
    """
    for path in paths:
        require_folder_of(path)
    if not may_exist and (taken := [str(path) for path in paths if path.exists()]):
        raise UsageError(
            f"{', '.join(taken)}: already there; choose another name, or say --overwrite"
        )


def require_folder_of(path: Path) -> None:
    """Raises UsageError unless the folder that `path` lies in exists."""
    folder = path.absolute().parent
    if not folder.is_dir():
        raise UsageError(f"{path}: there is no folder {folder}")
