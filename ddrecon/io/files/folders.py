"""Output folders and files: nothing of others is touched, and one process at a time writes.

A folder has a manifest: which kind of job writes there, and the name of each file that it wrote.
The operating system locks a file that names its holder, and lets go when its process ends, however
it ends, so what a killed process left behind is only a name.
"""

import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from ddrecon.errors import DataWarning, UsageError
from ddrecon.io.files.atomic import (
    claimed,
    is_temporary,
    note_written,
    refusals,
    write_bytes,
)

LOCK, MANIFEST = "ddrecon.lock", "ddrecon.manifest"
"""The names of the lock file, and of the file that names the others."""
KINDS = "run", "film", "uncertainty", "render", "reference", "bench"
RUN, FILM, UNCERTAINTY, RENDER, REFERENCE, BENCH = KINDS
"""The kinds of jobs that write folders."""
TEXT: dict[str, Any] = {"encoding": "utf-8", "errors": "surrogateescape"}


class Folder:
    """A folder that a job of a `kind` writes to, this process alone; `names` are its files.

    The name of a folder within, which has a manifest of its own, ends in a slash.
    """

    def __init__(self, path: Path, kind: str):
        self.path, self.kind, self.names = path, kind, dict.fromkeys(_read_manifest(path)[1])

    def note(self, file: Path, mark: str) -> None:
        """Adds `file` to the manifest before it is written; another's file is moved aside."""
        name = file.relative_to(os.path.abspath(self.path)).as_posix() + mark
        if name in self.names or file.name == MANIFEST:
            return
        if file.is_file():
            aside = next(
                place
                for count in range(1, 10**6)
                if not (place := file.with_name(f"{file.stem}.{count}{file.suffix}")).exists()
            )
            file.rename(aside)
            warnings.warn(f"{file}: was not written by ddrecon; now {aside.name}", DataWarning, 2)
        self.names[name] = None
        with (self.path / MANIFEST).open("a", **TEXT) as stream:
            stream.write(f"{name}\n")

    def clear(self, kept: Iterable[Path] = (), beginnings: Sequence[str] = ("",)) -> None:
        """Removes the files that the manifest names, but for those `kept`, and emptied folders.

        Names have one of the `beginnings`. Raises UsageError, before anything is removed, where
        another process writes to a folder within; FormatError where the system refuses.
        """
        stay = {path.resolve() for path in kept}
        chosen = [self.path / name for name in self.names if name.startswith(tuple(beginnings))]
        within = [path for path in chosen if path.is_dir() and (path / MANIFEST).is_file()]
        for path in within:
            with hold(path / LOCK):
                pass
        for path in within:
            with claim_folder(path, kind_of_folder(path) or "", overwrite=True) as folder:
                folder.clear(stay)
        with refusals(self.path):
            for path in chosen:
                if path.is_file() and path.resolve() not in stay:
                    path.unlink()
            for place in self.places():
                with suppress(OSError):  # it holds something else
                    place.rmdir()
        left = (n for n in self.names if (self.path / re.sub("/$", f"/{MANIFEST}", n)).is_file())
        self.names = dict.fromkeys(left)
        self.write()

    def places(self) -> list[Path]:
        """The folders within that hold files of the manifest, inner ones first."""
        paths = {up for name in self.names for up in (Path(name), *Path(name).parents)}
        return sorted(self.path / path for path in paths if (self.path / path).is_dir())[:0:-1]

    def require(self, overwrite: bool, resume: bool) -> None:
        """Raises UsageError where files are that are neither to be kept nor gone on with."""
        kind, content = kind_of_folder(self.path), self.content()
        if kind is None and content and not overwrite:
            strange = f"holds {content[0]}, which ddrecon did not write"
            advice = "choose another folder, or say --overwrite, which keeps it"
            if resume:
                strange = f"no {MANIFEST} says who wrote {content[0]}"
                advice = f"if ddrecon did, write a line `ddrecon {self.kind}` into that file"
            raise UsageError(f"{self.path}: {strange}; {advice}")
        if kind not in (None, self.kind):
            raise UsageError(
                f"{self.path}: is the folder of another kind of job, {kind}; choose another folder"
            )
        if self.names and not (overwrite or resume):
            also = " or --resume" if self.kind in (RUN, FILM, UNCERTAINTY) else ""
            raise UsageError(
                f"{self.path}: the folder is not empty; choose another, or say --overwrite{also}"
            )

    def content(self) -> list[str]:
        """The names of all that is in the folder, but for what this class itself writes there."""
        entries = (entry for entry in sorted(self.path.iterdir()) if not is_temporary(entry))
        return [entry.name for entry in entries if entry.name not in (LOCK, MANIFEST)]

    def write(self) -> None:
        """Writes the manifest."""
        text = "".join(f"{line}\n" for line in (f"ddrecon {self.kind}", *self.names))
        write_bytes(self.path / MANIFEST, text.encode(**TEXT))


@contextmanager
def claim_folder(
    path: Path,
    kind: str,
    *,
    overwrite: bool = False,
    resume: bool = False,
) -> Iterator[Folder]:
    """Makes the folder `path` of this `kind`, and keeps other processes out until the block ends.

    What is there stays; a job that is to `overwrite` it clears it once it can begin. A folder in
    which nothing was written is gone afterwards. Raises UsageError where `path` is a file or cannot
    be locked, where it is of another kind, where it holds files of others and is not to be
    overwritten, which keeps these, where it holds its own and neither is said, and where another
    process writes there.
    """
    if path.exists() and not path.is_dir():
        raise UsageError(f"{path}: is a file; name a folder for the output")
    lacking = [place for place in (path, *path.parents) if not place.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: cannot be made: {error.strerror or error}") from error
    key = Path(os.path.abspath(path))
    try:
        with hold(path / LOCK):
            folder = Folder(path, kind)
            folder.require(overwrite, resume)
            for place in (path, *folder.places()):
                for file in filter(is_temporary, place.iterdir()):  # of processes that were killed
                    file.unlink(missing_ok=True)
            with refusals(path):
                note_written(path, "/")
            claimed[key], is_new = folder.note, kind_of_folder(path) is None
            try:
                folder.write()
                yield folder
            finally:
                del claimed[key]
                if not folder.content() or (is_new and not folder.names):
                    (path / MANIFEST).unlink(missing_ok=True)
    finally:
        for place in lacking:
            with suppress(OSError):  # something is there
                place.rmdir()


@contextmanager
def hold(lock: Path) -> Iterator[None]:
    """Keeps other processes from the file `lock` until the block ends.

    Raises UsageError where it cannot be locked, and where another process holds it.
    """
    # No soft locks: what they leave behind would have to be judged stale or not.
    file_lock = FileLock(lock, fallback_to_soft=False)
    try:
        try:
            file_lock.acquire(timeout=0)
        except Timeout:
            holder = ""
            with suppress(OSError):  # it may be gone by now; some releases of filelock empty it
                holder = lock.read_text()
            process = f"process {holder}" if holder.isdigit() else "another process"
            advice = "wait for it, or choose another folder"
            raise UsageError(f"{lock.parent}: {process} is writing there; {advice}") from None
    except OSError as error:
        raise UsageError(f"{lock}: cannot be locked: {error.strerror or error}") from error
    try:
        with suppress(OSError):  # a full disk
            lock.write_text(str(os.getpid()))
        yield
    finally:
        # Before the lock goes: whoever waits for a file without a name has to begin again.
        lock.unlink(missing_ok=True)
        file_lock.release()


def kind_of_folder(path: Path) -> str | None:
    """The kind of job that wrote the folder `path`; None without a manifest that says it."""
    return _read_manifest(path)[0]


def _read_manifest(path: Path) -> tuple[str | None, list[str]]:
    """The kind and the names in the manifest of the folder `path`, but what leads out of it.

    A last line may be torn.
    """
    try:
        kind, *names = (path / MANIFEST).read_bytes().decode(**TEXT).split("\n")
    except OSError:
        return None, []
    kind = kind.removeprefix("ddrecon ")
    inner = [n for n in names[:-1] if not (n.startswith("/") or ".." in Path(n).parts)]
    return (kind, inner) if kind in KINDS else (None, [])


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
