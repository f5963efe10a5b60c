"""Output files and folders: only one process writes, and nothing is overwritten unasked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ddrecon.errors import UsageError
from ddrecon.io.files.lock import LOCK, hold_lock


@contextmanager
def claim_folder(path: Path, *, may_exist: bool) -> Iterator[None]:
    """Makes the folder `path`, and keeps other processes out of it until the block ends.

    Raises UsageError where it is a file, where another process writes there, or where it holds
    something and `may_exist` is False.
    """
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: is a file; name a folder for the output")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: cannot be made: {error.strerror or error}") from error
    with hold_lock(path):
        if not may_exist and any(entry.name != LOCK for entry in path.iterdir()):
            raise UsageError(f"{path}: the folder is not empty; choose another, or say --overwrite")
        yield


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
