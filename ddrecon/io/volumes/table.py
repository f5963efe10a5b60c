"""Volumes by suffix: `FORMATS` is the table; adding a format is a reader and one line here.

The plainest formats are here themselves: NumPy's archives (.npz) have each field under its own
name, and its box as `bounds`. Mitsuba's grid volumes (.vol) have a header of 48 bytes, then float32
values, little-endian, of one field without a name. The header: `VOL`, version 3, then int32 type
(1: float32), cells along x, y, z and colors, then the box as six float32. Of values, colors run
fastest, then x.
"""

import struct
import warnings
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddrecon.errors import DataWarning, FormatError
from ddrecon.io.files.atomic import replace_file, write_bytes
from ddrecon.io.files.reading import as_float32, check_size, guard_reading, read_npy
from ddrecon.io.volumes.field import BOX, VECTORS, Facts, Field, Fields, check_field
from ddrecon.io.volumes.netcdf import netcdf_names, read_netcdf
from ddrecon.io.volumes.vdb import read_grids, read_vdb, write_vdb

BOUNDS = "bounds"
HEADER = struct.Struct("<3sB5i6f")
MAGIC, VERSION, FLOAT32 = b"VOL", 3, 1


def npz_names(path: Path) -> list[str]:
    """The names of all arrays of the archive at `path` but `bounds`."""
    with zipfile.ZipFile(path) as archive:
        names = (entry.removesuffix(".npy") for entry in archive.namelist())
        return [name for name in names if name != BOUNDS]


def read_npz(path: Path, name: str) -> Field:
    """The field `name` of the archive at `path`; raises FormatError unless it is a legal one."""
    with zipfile.ZipFile(path) as archive:

        def read(key: str) -> np.ndarray:
            entry = archive.getinfo(f"{key}.npy")
            with archive.open(entry) as stream:
                return read_npy(stream, entry.file_size, path, key)

        has_bounds = f"{BOUNDS}.npy" in archive.namelist()
        return check_field(path, name, read(name), read(BOUNDS) if has_bounds else None)


def write_npz(path: Path, fields: Fields, bounds: np.ndarray, _: Facts) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 under their names, compressed.

    `bounds` [2, 3] are the corners (x, y, z) of the box [u].
    """
    arrays = {name: np.asarray(values, np.float32) for name, values in fields.items()}
    with replace_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **(arrays | {BOUNDS: bounds}))


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


def write_vol(path: Path, fields: Fields, bounds: np.ndarray, _: Facts) -> None:
    """Writes the one of `fields`, [z, y, x] or [z, y, x, C], and its box, both as float32.

    `bounds` [2, 3] are the corners (x, y, z) [u]. Raises FormatError for several fields.
    """
    if len(fields) != 1:
        names = ", ".join(fields)
        advice = "write each into a file of its own"
        raise FormatError(path, f"a {path.suffix} holds one field, not {names}; {advice}")
    (values,) = map(as_float32, fields.values())
    z, y, x = values.shape[:3]
    header = HEADER.pack(MAGIC, VERSION, FLOAT32, x, y, z, values[0, 0, 0].size, *bounds.ravel())
    write_bytes(path, header + values.astype("<f4", copy=False).tobytes())


class VolumeFormat(NamedTuple):
    """How one kind of volume file is read and written.

    Without `names`, a file holds one field and does not name it; without `write` it is only read.
    """

    write: Callable[[Path, Fields, np.ndarray, Facts], None] | None
    read: Callable[[Path, str], Field]
    names: Callable[[Path], Iterable[str]] | None = None


FORMATS: dict[str, VolumeFormat] = {
    ".npz": VolumeFormat(write_npz, read_npz, npz_names),
    ".vol": VolumeFormat(write_vol, read_vol),
    ".vdb": VolumeFormat(write_vdb, read_vdb, read_grids),
    ".nc": VolumeFormat(None, read_netcdf, netcdf_names),
}
NANOVDB = ".nvdb"
"""A suffix that is known and not read."""
WRITTEN = [suffix for suffix, kind in FORMATS.items() if kind.write]
"""The suffixes of formats that are written."""


def _format_of(path: Path) -> VolumeFormat:
    if (suffix := path.suffix.lower()) not in FORMATS:
        suffixes = ", ".join(FORMATS)
        advice = f"; try nanovdb_convert {path.name} {path.stem}.vdb" if suffix == NANOVDB else ""
        raise FormatError(path, f"unknown volume format {path.suffix!r}; known: {suffixes}{advice}")
    return FORMATS[suffix]


def field_names(path: Path) -> list[str]:
    """The fields that the volume file at `path` holds; where it does not say, its own name's end.

    Raises FormatError when it cannot be read.
    """
    names = _format_of(path).names
    with guard_reading(path):
        return list(names(path)) if names else [path.stem.rpartition(".")[2]]


def read_field(path: Path, name: str) -> Field:
    """The field `name` (`density`, ...) of the volume at `path`; raises FormatError if unusable."""
    kind = _format_of(path)
    with guard_reading(path):
        if kind.names and name not in (names := list(kind.names(path))):
            names_text = ", ".join(map(repr, names)) or "none"
            advice = f"; say name: {names[0]} beside its path" if len(names) == 1 else ""
            raise FormatError(path, f"has no field {name!r}; it has {names_text}{advice}")
        return kind.read(path, name)


def read_fields(path: Path) -> tuple[dict[str, Field], dict[str, str]]:
    """The fields of the same cells in the volume at `path`, and why all else in it is none.

    Both are by name. Raises FormatError where nothing in the file is a field.
    """
    fields, reasons, read = dict[str, Field](), dict[str, str](), _format_of(path).read
    for name in (names := field_names(path)):
        try:
            with guard_reading(path):
                field = read(path, name)
        except FormatError as error:
            if name == names[-1] and not fields:
                raise
            reasons[name] = error.reason
            continue
        if fields and _place(field) != (first := _place(next(iter(fields.values())))):
            reasons[name] = f"{name} has {_place(field)}, not {first}"
        else:
            fields[name] = field
    return fields, reasons


def write_field(path: Path, name: str, values: np.ndarray, bounds: np.ndarray) -> None:
    """Writes `values` [z, y, x] or [z, y, x, 3], as float32, in the format of `path`'s suffix.

    `bounds` [2, 3] are the corners (x, y, z) of the box [u].
    """
    write_fields(path, {name: values}, bounds)


def write_fields(
    path: Path, fields: Fields, bounds: np.ndarray, facts: Facts | None = None
) -> None:
    """Writes several fields of the same cells, by name, each as `write_field` does.

    `facts` are written where the format takes any. Raises FormatError where it holds but one field,
    or is not written.
    """
    if (write := _format_of(path).write) is None:
        raise FormatError(path, f"{path.suffix} is read, not written: take {', '.join(WRITTEN)}")
    write(path, fields, np.asarray(bounds, np.float64), facts or {})


def read_together(sources: Sequence[Path]) -> tuple[Fields, np.ndarray]:
    """All fields of the volumes `sources`, and their box.

    Raises FormatError for volumes of different cells or boxes, and for none at all.
    """
    fields, first = dict[str, Field](), None
    for path in sources:
        stored, reasons = read_fields(path)
        for reason in reasons.values():
            warnings.warn(f"{path}: left out: {reason}", DataWarning, 2)
        for name, field in stored.items():
            first = field if first is None else first
            if name in fields:
                raise FormatError(path, f"has a field {name!r}, and so has a file before it")
            if field.bounds is None:
                raise FormatError(path, f'says no box; add an array "bounds", {BOX}')
            if (ours := _place(field)) != (theirs := _place(first)):
                raise FormatError(path, f"has {ours}, the first field {theirs}")
            fields[name] = field
    if first is None or first.bounds is None:
        raise FormatError(sources[0], "has no fields")
    return {name: field.values for name, field in fields.items()}, first.bounds


def _place(field: Field) -> str:
    cells = " x ".join(map(str, field.resolution))
    box = "no box" if field.bounds is None else f"the box {field.bounds.tolist()}"
    return f"{cells} cells (x, y, z) in {box}"


def turn_up(
    fields: Fields, bounds: np.ndarray, old_up: str, new_up: str
) -> tuple[Fields, np.ndarray]:
    """`fields` and their box turned so that the axis `new_up` points up where `old_up` did.

    From y to z (x, y, z) is (x, -z, y).
    """
    if old_up == new_up:
        return fields, bounds
    old, new = ("xyz".index(name) for name in (old_up, new_up))
    turned = {
        name: np.flip(values.swapaxes(2 - old, 2 - new), 2 - old) for name, values in fields.items()
    }
    box, (low, high) = bounds.copy(), bounds
    box[:, new], box[:, old] = bounds[:, old], (-high[new], -low[new])
    for name in turned.keys() & set(VECTORS):
        along = turned[name].copy()
        along[..., new], along[..., old] = turned[name][..., old], -turned[name][..., new]
        turned[name] = along
    return turned, box
