"""One process at a time in a folder: a lock file that says which, and that is seen to be stale once
the process is gone.

A process is known by its number and by when it started, since numbers are used again. Of processes
on other machines nothing is known.
"""

from __future__ import annotations

import json
import os
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ddrecon.errors import SceneError

LOCK = "ddrecon.lock"
"""The name of the lock file."""
MAX_BYTES = 4096
"""No lock is larger."""


@contextmanager
def hold_lock(folder: Path) -> Iterator[None]:
    """Nobody else's `folder` until the block ends; raises SceneError while another process has it."""
    path = folder / LOCK
    _acquire(path)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _acquire(path: Path) -> None:
    own = json.dumps(_identity(os.getpid()))
    while True:
        try:
            handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            _discard_stale(path)
            continue
        except OSError as error:
            raise SceneError(f"{path}: cannot be made: {error.strerror or error}") from error
        with os.fdopen(handle, "w") as stream:
            stream.write(own)
        return


def _discard_stale(path: Path) -> None:
    """Removes the lock at `path` if its process is gone, and raises SceneError if not.

    It is looked at again under a name of its own: another process may have replaced it in between.
    """
    _require_stale(path, _read(path))
    aside = path.with_name(f".{LOCK}-{uuid.uuid4().hex[:12]}")
    try:
        os.rename(path, aside)
    except FileNotFoundError:
        return
    try:
        _require_stale(path, _read(aside))
    except SceneError:
        os.rename(aside, path)
        raise
    aside.unlink()


def _read(path: Path) -> dict[str, Any] | None:
    """What the lock at `path` says; None where it is gone, {} where it says nothing that can be
    understood.
    """
    try:
        content = (
            json.loads(path.read_bytes())
            if path.stat().st_size <= MAX_BYTES and path.is_file()
            else None
        )
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _require_stale(path: Path, holder: dict[str, Any] | None) -> None:
    if holder is None:
        return
    pid, host = holder.get("pid"), holder.get("host")
    if not isinstance(pid, int) or not isinstance(host, str):
        raise SceneError(
            f"{path}: a lock that does not say whose it is; if nothing writes to {path.parent}, remove it"
        )
    if host != socket.gethostname():
        raise SceneError(
            f"{path.parent}: process {pid} on {host!r} is writing there; if it is not, remove {path}"
        )
    if _identity(pid) == holder:
        raise SceneError(
            f"{path.parent}: process {pid} is writing there; wait for it, or choose another folder"
        )


def _identity(pid: int) -> dict[str, Any] | None:
    """Who process `pid` of this machine is: its number, and when it started where the system tells;
    None if there is no such process.
    """
    identity = {"pid": pid, "host": socket.gethostname()}
    try:
        state, *numbers = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except FileNotFoundError:
        return identity if not Path("/proc/self/stat").exists() and _is_running(pid) else None
    except OSError:
        return identity
    is_over = state in "ZX"
    return (
        None
        if is_over
        else {
            **identity,
            "boot": Path("/proc/sys/kernel/random/boot_id").read_text().strip(),
            "start": numbers[18],
        }
    )


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
