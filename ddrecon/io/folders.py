"""Output folders: nothing that is there is ever overwritten without being asked to."""

from __future__ import annotations

from pathlib import Path

from ddrecon.errors import SceneError


def prepare_folder(path: Path, *, may_exist: bool) -> None:
    """Makes the folder `path`; raises SceneError where it is a file, or holds something and `may_exist` is False."""
    if path.exists() and not path.is_dir():
        raise SceneError(f"{path}: is a file; name a folder for the output")
    if path.is_dir() and any(path.iterdir()) and not may_exist:
        raise SceneError(f"{path}: the folder is not empty; choose another, or say --overwrite")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(f"{path}: cannot be made: {error.strerror or error}") from error
