"""One process at a time in a folder: the operating system locks a file that names its holder.

The system lets go of a lock when its process ends, however it ends, so what a killed process left
behind is only a name. Between machines that share a folder no system does so reliably: the name of
another host is taken at its word.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ddrecon.errors import UsageError

LOCK = "ddrecon.lock"
"""The name of the lock file."""


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
