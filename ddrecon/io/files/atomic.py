"""Writing files so that a reader, or an interrupted run, never sees half of one.

Whatever is written so inside a folder that this process has claimed is noted in its manifest.
"""

import json
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ddrecon.errors import FormatError, is_utf8

_TEMPORARY = re.compile(r"\..*\.partial-[0-9a-f]{12}(\..*)?")
claimed: dict[Path, Callable[[Path, str], None]] = {}
"""What notes files, by the absolute paths of the folders that this process has claimed."""


def note_written(path: Path, mark: str = "") -> None:
    """Has the claimed folder nearest above `path`, if any, note that it is written.

    A `mark` of "/" says that it is a folder with a manifest of its own.
    """
    absolute = Path(os.path.abspath(path))
    for folder in filter(claimed.__contains__, absolute.parents):
        claimed[folder](absolute, mark)
        break


@contextmanager
def replace_file(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`, with its suffix, for a block to write to.

    It becomes `path` when the block ends well, and vanishes when not. Raises FormatError where the
    system refuses to write, or where other programs and scene files could not name it.
    """
    temporary = path.with_name(f".{path.stem}.partial-{uuid.uuid4().hex[:12]}{path.suffix}")
    if not is_utf8(path):
        raise FormatError(path, "cannot be written: its name is not UTF-8; choose another")
    with refusals(path):
        note_written(path)
        try:
            yield temporary
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


@contextmanager
def replace_file_durably(path: Path, kept_as: Path) -> Iterator[Path]:
    """`replace_file` that is safe from a loss of power once it has ended.

    What `path` was until then is kept as `kept_as`; `path` is there at any time.
    """
    with replace_file(path) as temporary:
        yield temporary
        flush(temporary)
        if path.exists():
            with replace_file(kept_as) as kept:
                try:
                    os.link(path, kept)
                except OSError:  # of a system without links
                    shutil.copyfile(path, kept)
    with suppress(FormatError):  # Windows and some network drives flush no folders
        flush(path.parent)


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` to `path`."""
    with replace_file(path) as temporary:
        temporary.write_bytes(data)


def json_text(content: Any) -> str:
    """`content` as JSON, indented; a number that is not finite is null, as JSON has no such."""
    plain = json.loads(json.dumps(content), parse_constant=lambda _: None)
    return json.dumps(plain, indent=1)


def write_json(path: Path, content: Any) -> None:
    """Writes `json_text` of `content` to `path`."""
    write_bytes(path, f"{json_text(content)}\n".encode())


def is_temporary(path: Path) -> bool:
    """Whether `path` is named as what `replace_file` gives a block to write to."""
    return _TEMPORARY.fullmatch(path.name) is not None


def flush(path: Path) -> None:
    """Puts the file or folder at `path` on its disk; raises FormatError where the system cannot."""
    with refusals(path):
        # Windows puts only what it may write on its disk.
        handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def refusals(path: Path) -> Iterator[None]:
    """An OSError inside the block becomes a FormatError that says `path` cannot be written."""
    try:
        yield
    except OSError as error:
        raise FormatError(path, f"cannot be written: {error.strerror or error}") from error
