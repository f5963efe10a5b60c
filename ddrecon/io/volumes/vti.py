"""Volumes as VTK image data (.vti), which ParaView opens; written, not read.

Each field is a cell array of its own name, of float32, with three components for colors; appended
raw.
"""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn
from xml.sax.saxutils import quoteattr

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import as_float32
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import Fields

FILE = """<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
<ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}">
<Piece Extent="{extent}">
<CellData>
{arrays}</CellData>
</Piece>
</ImageData>
<AppendedData encoding="raw">
_"""
ARRAY = """<DataArray type="Float32" Name={name} NumberOfComponents="{count}" format="appended" \
offset="{offset}"/>
"""


def write_vti(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 cells, and their box.

    `bounds` [2, 3], its corners (x, y, z) [u], are written as origin and spacing.
    """
    cells = next(iter(fields.values())).shape[2::-1]
    origin, spacing = (
        " ".join(map(repr, line.tolist())) for line in (bounds[0], (bounds[1] - bounds[0]) / cells)
    )
    arrays, data = "", b""
    for name, values in fields.items():
        count = values.shape[3] if values.ndim == 4 else 1
        arrays += ARRAY.format(name=quoteattr(name), count=count, offset=len(data))
        block = as_float32(values).astype("<f4", copy=False).tobytes()
        data += len(block).to_bytes(8, "little") + block
    extent = " ".join(f"0 {count}" for count in cells)
    head = FILE.format(extent=extent, origin=origin, spacing=spacing, arrays=arrays)
    with replace_file(path) as temporary:
        temporary.write_bytes(head.encode() + data + b"\n</AppendedData>\n</VTKFile>\n")


def refuse_vti(path: Path, *_: str) -> NoReturn:
    """Raises FormatError, which says what is read instead."""
    raise FormatError(
        path, ".vti is written, not read: save the volume as .npz or .nc (docs/formats.md)"
    )
