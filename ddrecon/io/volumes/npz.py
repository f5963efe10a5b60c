"""Volumes as NumPy archives: each field under its own name, and its box as `bounds`.

`bounds` is [[xmin, ymin, zmin], [xmax, ymax, zmax]].
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from ddrecon.io.files.arrays import read_npy
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import Field, Fields, check_field

BOUNDS = "bounds"


def npz_names(path: Path) -> list[str]:
    """The names of all arrays of the archive at `path` but `bounds`."""
    with zipfile.ZipFile(path) as archive:
        names = (entry.removesuffix(".npy") for entry in archive.namelist())
        return [name for name in names if name != BOUNDS]


def read_npz(path: Path, name: str) -> Field:
    """The field `name` of the archive at `path`; raises FormatError unless it is a legal one."""
    with zipfile.ZipFile(path) as archive:
        values = _read_entry(archive, name, path)
        has_bounds = f"{BOUNDS}.npy" in archive.namelist()
        bounds = _read_entry(archive, BOUNDS, path) if has_bounds else None
    return check_field(path, name, values, bounds)


def _read_entry(archive: zipfile.ZipFile, name: str, path: Path) -> np.ndarray:
    entry = archive.getinfo(f"{name}.npy")
    with archive.open(entry) as stream:
        return read_npy(stream, entry.file_size, path, name)


def write_npz(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 under their names, compressed.

    `bounds` [2, 3] are the corners (x, y, z) of the box [u].
    """
    arrays = {name: np.asarray(values, np.float32) for name, values in fields.items()}
    with replace_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **(arrays | {BOUNDS: bounds}))
