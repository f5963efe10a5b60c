"""Volumes whose bytes lie plainly: NumPy archives and Mitsuba's .vol.

An archive (.npz) has each field under its own name, and its box as `bounds`.

Mitsuba's grid volumes (.vol) have a header of 48 bytes, then float32 values, little-endian, of one
field without a name. The header: `VOL`, version 3, then int32 type (1: float32), cells along x, y,
z and colors, then the box as six float32. Of values, colors run fastest, then x.
"""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import as_float32, check_size, read_npy
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import Field, Fields, check_field, require_only_field

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


HEADER = struct.Struct("<3sB5i6f")
MAGIC, VERSION, FLOAT32 = b"VOL", 3, 1


def read_vol(path: Path, name: str) -> Field:
    """The field in the file at `path`, taken for `name`; raises FormatError unless it is legal."""
    check_size(path.stat().st_size, path, "the volume")
    data = path.read_bytes()
    if len(data) < HEADER.size or data[:3] != MAGIC:
        raise FormatError(path, "not a Mitsuba volume: it does not begin with 'VOL' and a header")
    _, version, kind, x, y, z, colors, *corners = HEADER.unpack_from(data)
    if (version, kind) != (VERSION, FLOAT32):
        readable = f"only version {VERSION} with float32 values (type {FLOAT32}) can be read"
        raise FormatError(path, f"is of version {version} and type {kind}; {readable}")
    if min(x, y, z, colors) < 1 or len(data) != HEADER.size + 4 * x * y * z * colors:
        cells_text = f"{x} x {y} x {z} cells of {colors}, which is not the size of its data"
        raise FormatError(path, f"is damaged: its header says {cells_text}")
    values = np.frombuffer(data, "<f4", offset=HEADER.size).reshape(z, y, x, colors)
    return check_field(path, name, values, np.array(corners).reshape(2, 3))


def write_vol(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes the one of `fields`, [z, y, x] or [z, y, x, C], and its box, both as float32.

    `bounds` [2, 3] are the corners (x, y, z) [u]. The format knows no names.
    """
    values = as_float32(require_only_field(path, fields))
    colors = values.shape[3] if values.ndim == 4 else 1
    z, y, x = values.shape[:3]
    header = HEADER.pack(MAGIC, VERSION, FLOAT32, x, y, z, colors, *bounds.ravel())
    with replace_file(path) as temporary:
        temporary.write_bytes(header + values.astype("<f4", copy=False).tobytes())
