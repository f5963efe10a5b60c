"""Mitsuba's grid volumes (.vol): a header of 48 bytes, then float32 values, little-endian.

The header: `VOL`, version 3, then int32 type (1: float32), cells along x, y, z and colors, then the
box as six float32. Of values, colors run fastest, then x. A file holds one field, without a name.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import Field, Fields, check_field, require_only_field

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
        known = f"only version {VERSION} with float32 values (type {FLOAT32}) can be read"
        raise FormatError(path, f"is of version {version} and type {kind}; {known}")
    if min(x, y, z, colors) < 1 or len(data) != HEADER.size + 4 * x * y * z * colors:
        told = f"{x} x {y} x {z} cells of {colors}, which is not the size of its data"
        raise FormatError(path, f"is damaged: its header says {told}")
    values = np.frombuffer(data, "<f4", offset=HEADER.size).reshape(z, y, x, colors)
    values = values[..., 0] if colors == 1 else values
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
