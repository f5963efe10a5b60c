"""Volumes as NumPy archives: each field under its own name, and its box as `bounds`.

`bounds` is [[xmin, ymin, zmin], [xmax, ymax, zmax]].
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import read_npy
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import Field, Fields, check_field

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def read_npz(path: Path, name: str) -> Field:
    """The field `name` of the archive at `path`.

    Raises FormatError when it is damaged, absent or not a legal field.
    """
    with _open(path) as archive:
        names = _names(archive)
        if name not in names:
            raise FormatError(path, _explain_absence(name, _without_bounds(names)))
        bounds = _read_entry(archive, "bounds", path) if "bounds" in names else None
        values = _read_entry(archive, name, path)
    return check_field(path, name, values, bounds)


def npz_names(path: Path) -> list[str]:
    """The names of all arrays of the archive at `path` but `bounds`.

    Raises FormatError when it is damaged.
    """
    with _open(path) as archive:
        return _without_bounds(_names(archive))


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of the archive at `path` by name. Raises FormatError when it is damaged."""
    with _open(path) as archive:
        return {name: _read_entry(archive, name, path) for name in _names(archive)}


@contextmanager
def _open(path: Path) -> Iterator[zipfile.ZipFile]:
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except zipfile.BadZipFile as error:
        raise FormatError(
            path, f"not a complete .npz archive: {error}; write it with numpy.savez_compressed"
        ) from error


def _names(archive: zipfile.ZipFile) -> list[str]:
    return [entry.removesuffix(".npy") for entry in archive.namelist()]


def _without_bounds(names: list[str]) -> list[str]:
    return [name for name in names if name != "bounds"]


def write_npz(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 under their names, compressed.

    `bounds` [2, 3] are the corners (x, y, z) of the box [u].
    """
    with replace_file(path) as temporary, temporary.open("wb") as stream:
        arrays = {name: np.asarray(values, np.float32) for name, values in fields.items()} | {
            "bounds": np.asarray(bounds, np.float64)
        }
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]


def _read_entry(archive: zipfile.ZipFile, name: str, path: Path) -> np.ndarray:
    entry = archive.getinfo(f"{name}.npy")
    if entry.compress_type not in _METHODS:
        raise FormatError(
            path,
            f"{name} is compressed by method {entry.compress_type}; "
            "write it with numpy.savez_compressed",
        )
    with archive.open(entry) as stream:
        return read_npy(stream, entry.file_size, path, name)


def _explain_absence(name: str, others: list[str]) -> str:
    if len(others) == 1:
        return (
            f"has no field {name!r}, only {others[0]!r}; "
            f"save that array as {name!r}, or say name: {others[0]} beside file"
        )
    return f"has no field {name!r}; it has {', '.join(map(repr, others)) or 'none'}"
