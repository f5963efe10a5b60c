"""Volumes as VTK image data (.vti), which ParaView opens: each field a cell array of its own name,
three components for colors.

Written as float32, appended raw. Read: uncompressed cell arrays of float32 or float64, appended raw
or inline in base64 ("binary").
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import Field, Fields, check_field

APPENDED = re.compile(rb"<AppendedData[^>]*>\s*_")
TYPES = {"Float32": "f4", "Float64": "f8"}
HEADERS = {"UInt32": "u4", "UInt64": "u8"}
ORDERS = {"LittleEndian": "<", "BigEndian": ">"}
ADVICE = 'save it uncompressed, cell data as Float32, encoded "Appended raw" or "Binary"'


def write_vti(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 cells, and `bounds` [2, 3] (x, y,
    z) as origin and spacing.
    """
    cells, (low, high) = (
        np.array(next(iter(fields.values())).shape[2::-1]),
        np.asarray(bounds, np.float64),
    )
    extent = " ".join(f"0 {count}" for count in cells)
    origin, spacing = (
        " ".join(repr(float(number)) for number in line) for line in (low, (high - low) / cells)
    )
    arrays, data = "", b""
    for name, values in fields.items():
        components = values.shape[3] if values.ndim == 4 else 1
        arrays += f'<DataArray type="Float32" Name={quoteattr(name)} NumberOfComponents="{components}" format="appended" offset="{len(data)}"/>\n'
        block = as_float32(values).astype("<f4", copy=False).tobytes()
        data += np.array(len(block), "<u8").tobytes() + block
    head = f"""<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
<ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}">
<Piece Extent="{extent}">
<CellData>
{arrays}</CellData>
</Piece>
</ImageData>
<AppendedData encoding="raw">
_"""
    with replace_file(path) as temporary:
        temporary.write_bytes(head.encode() + data + b"\n</AppendedData>\n</VTKFile>\n")


def vti_names(path: Path) -> list[str]:
    """The names of the cell arrays of the file at `path`; raises FormatError when it is damaged."""
    with _open(path) as (root, _):
        return list(_arrays(_piece(root)))


def read_vti(path: Path, name: str) -> Field:
    """The cell array `name` of the file at `path`; raises FormatError when it is damaged, absent,
    compressed or not a legal field.
    """
    with _open(path) as (root, appended):
        values, bounds = _read(path, root, appended, name)
    return check_field(path, name, values, bounds)


@contextmanager
def _open(path: Path) -> Iterator[tuple[ElementTree.Element, bytes]]:
    """The XML of the file at `path`, and the data appended to it."""
    try:
        check_size(path.stat().st_size, path, "the volume")
        content = path.read_bytes()
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
    head, appended = _split(content)
    if b"<!DOCTYPE" in head:
        raise FormatError(
            path, f"has a document type, which may define entities without end; {ADVICE}"
        )
    try:
        yield ElementTree.fromstring(head), appended
    except (ElementTree.ParseError, ValueError, KeyError, OverflowError) as error:
        raise FormatError(
            path, f"not VTK image data that can be read ({error}); {ADVICE}"
        ) from error


def _split(content: bytes) -> tuple[bytes, bytes]:
    """What is XML, and the raw data appended to it, which are not."""
    mark = APPENDED.search(content)
    if mark is None:
        return content, b""
    return content[: mark.start()] + b"</VTKFile>", content[mark.end() :]


def _read(
    path: Path, root: ElementTree.Element, appended: bytes, name: str
) -> tuple[np.ndarray, np.ndarray]:
    if "compressor" in root.attrib:
        raise ValueError("compressed")
    image = _only(root, "ImageData")
    extent = [int(number) for number in image.attrib["WholeExtent"].split()]
    x, y, z = (last - first for first, last in zip(extent[::2], extent[1::2], strict=True))
    origin, spacing = (
        np.array([float(number) for number in image.get(key, one).split()])
        for key, one in (("Origin", "0 0 0"), ("Spacing", "1 1 1"))
    )
    low = origin + spacing * extent[::2]
    arrays = _arrays(_piece(root))
    if name not in arrays:
        raise FormatError(
            path, f"has no cell array {name!r}; it has {', '.join(map(repr, arrays)) or 'none'}"
        )
    array = arrays[name]
    order = ORDERS[root.get("byte_order", "LittleEndian")]
    header = np.dtype(order + HEADERS[root.get("header_type", "UInt32")])
    data = _data(array, appended, header)
    components = int(array.get("NumberOfComponents", 1))
    values = np.frombuffer(data, order + TYPES[array.attrib["type"]])
    shape = (z, y, x) if components == 1 else (z, y, x, components)
    return values.reshape(shape), np.stack([low, low + spacing * [x, y, z]])


def _piece(root: ElementTree.Element) -> ElementTree.Element:
    if root.get("type") != "ImageData":
        raise ValueError(f"of type {root.get('type')}")
    image = _only(root, "ImageData")
    piece = _only(image, "Piece")
    if piece.attrib["Extent"].split() != image.attrib["WholeExtent"].split():
        raise ValueError("in several pieces")
    return piece


def _arrays(piece: ElementTree.Element) -> dict[str, ElementTree.Element]:
    return {array.get("Name", ""): array for array in piece.iterfind("CellData/DataArray")}


def _only(parent: ElementTree.Element, tag: str) -> ElementTree.Element:
    children = parent.findall(tag)
    if len(children) != 1:
        raise ValueError(f"{len(children)} elements {tag}")
    return children[0]


def _data(array: ElementTree.Element, appended: bytes, header: np.dtype) -> bytes:
    """The bytes of `array`, behind a number that counts them."""
    if array.get("format") == "appended":
        content = appended[int(array.attrib["offset"]) :]
    elif array.get("format") == "binary":
        content = base64.b64decode("".join((array.text or "").split()), validate=True)
    else:
        raise ValueError(f"format {array.get('format')}")
    if len(content) < header.itemsize:
        raise ValueError("no data")
    count = int(np.frombuffer(content, header, 1)[0])
    data = content[header.itemsize : header.itemsize + count]
    if len(data) != count:
        raise ValueError("cut short")
    return data
