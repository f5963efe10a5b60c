"""Output folders and files: nothing is overwritten unasked, and one process at a time writes.

The operating system locks a file that names its holder, and lets go when its process ends, however
it ends, so what a killed process left behind is only a name. Between machines that share a folder
no system does so reliably: the name of another host is taken at its word.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ddrecon.errors import UsageError

LOCK = "ddrecon.lock"
"""The name of the lock file."""


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


@contextmanager
def hold_lock(folder: Path) -> Iterator[None]:
    """Keeps other processes out of `folder` until the block ends.

    Raises UsageError while another process holds it, and where the file cannot be locked.
    """
    path = folder / LOCK
    # Before it is opened: some releases of filelock empty the file they lock.
    if _read_holder(path).get("host", socket.gethostname()) != socket.gethostname():
        raise UsageError(_explain_refusal(path))
    try:
        # No soft locks: what they leave behind would have to be judged stale or not.
        lock = FileLock(path, fallback_to_soft=False).acquire(timeout=0)
    except Timeout:
        raise UsageError(_explain_refusal(path)) from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be locked: {error.strerror or error}") from error
    with lock:
        path.write_text(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}))
        try:
            yield
        finally:
            # Before the lock goes: whoever waits for a file without a name has to begin again.
            path.unlink(missing_ok=True)


def _read_holder(path: Path) -> dict[str, Any]:
    """The `pid` and `host` that the lock at `path` names; empty where it names none."""
    try:
        content = json.loads(path.read_bytes()) if path.is_file() else None
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) and content.keys() >= {"pid", "host"} else {}


def _explain_refusal(path: Path) -> str:
    holder = _read_holder(path)
    if holder and holder["host"] != socket.gethostname():
        return (
            f"{path.parent}: process {holder['pid']} on {holder['host']!r} is writing there; "
            f"if it is not, remove {path}"
        )
    process = f"process {holder['pid']}" if holder else "another process"
    return f"{path.parent}: {process} is writing there; wait for it, or choose another folder"
