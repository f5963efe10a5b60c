"""Output folders: nothing that is there is ever overwritten without being asked to, and only one
process writes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ddrecon.errors import SceneError
from ddrecon.io.files.lock import LOCK, hold_lock


@contextmanager
def claim_folder(path: Path, *, may_exist: bool) -> Iterator[None]:
    """Makes the folder `path`, and keeps other processes out of it until the block ends.

    Raises SceneError where it is a file, where another process writes there, or where it holds
    something and `may_exist` is False.
    """
    if path.exists() and not path.is_dir():
        raise SceneError(f"{path}: is a file; name a folder for the output")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(f"{path}: cannot be made: {error.strerror or error}") from error
    with hold_lock(path):
        if not may_exist and any(entry.name != LOCK for entry in path.iterdir()):
            raise SceneError(f"{path}: the folder is not empty; choose another, or say --overwrite")
        yield
