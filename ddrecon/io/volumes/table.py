"""Volumes by suffix: `FORMATS` is the table; adding a format is one file and one line here."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddrecon.errors import DataWarning, FormatError
from ddrecon.io.files.reading import guard_reading
from ddrecon.io.volumes.field import BOX, VECTORS, Facts, Field, Fields
from ddrecon.io.volumes.netcdf import netcdf_names, read_netcdf
from ddrecon.io.volumes.plain import npz_names, read_npz, read_vol, write_npz, write_vol
from ddrecon.io.volumes.vdb_read import read_vdb, vdb_names
from ddrecon.io.volumes.vdb_write import write_vdb


@dataclass(frozen=True)
class VolumeFormat:
    """How one kind of volume file is read and written.

    Without `names`, a file holds one field and does not name it; without `write` it is only read,
    and with `has_metadata` facts about fields are written.
    """

    write: Callable[..., None] | None
    read: Callable[[Path, str], Field]
    names: Callable[[Path], list[str]] | None = None
    has_metadata: bool = False


FORMATS: dict[str, VolumeFormat] = {
    ".npz": VolumeFormat(write_npz, read_npz, npz_names),
    ".vol": VolumeFormat(write_vol, read_vol),
    ".vdb": VolumeFormat(write_vdb, read_vdb, vdb_names, True),
    ".nc": VolumeFormat(None, read_netcdf, netcdf_names),
}
WRITTEN = [suffix for suffix, kind in FORMATS.items() if kind.write]
"""The suffixes of formats that are written."""


def field_names(path: Path) -> list[str]:
    """The fields that the volume file at `path` holds; where it does not say, its own name's end.

    Raises FormatError when it cannot be read.
    """
    names = _format_of(path).names
    with guard_reading(path):
        return names(path) if names else [path.stem.rpartition(".")[2]]


def read_field(path: Path, name: str) -> Field:
    """The field `name` (`density`, ...) of the volume at `path`; raises FormatError if unusable."""
    kind = _format_of(path)
    with guard_reading(path):
        if kind.names and name not in (names := kind.names(path)):
            names_text = ", ".join(map(repr, names)) or "none"
            advice = f"; say name: {names[0]} beside file" if len(names) == 1 else ""
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
    kind = _format_of(path)
    if (write := kind.write) is None:
        raise FormatError(path, f"{path.suffix} is read, not written: take {', '.join(WRITTEN)}")
    write(path, fields, np.asarray(bounds, np.float64), *[facts or {}] * kind.has_metadata)


def _format_of(path: Path) -> VolumeFormat:
    if (suffix := path.suffix.lower()) not in FORMATS:
        suffixes = ", ".join(FORMATS)
        raise FormatError(path, f"unknown volume format {path.suffix!r}; known: {suffixes}")
    return FORMATS[suffix]


def read_together(sources: Sequence[Path]) -> tuple[Fields, np.ndarray]:
    """All fields of the volumes `sources`, and their box.

    Raises FormatError for volumes of different cells or boxes, and for none at all.
    """
    fields: dict[str, Field] = {}
    for path in sources:
        stored, reasons = read_fields(path)
        for reason in reasons.values():
            warnings.warn(f"{path}: left out: {reason}", DataWarning, 2)
        for name, field in stored.items():
            if name in fields:
                raise FormatError(path, f"has a field {name!r}, and so has a file before it")
            fields[name] = field
            if field.bounds is None:
                raise FormatError(path, f'says no box; add an array "bounds", {BOX}')
            places = {_place(stored_field) for stored_field in fields.values()}
            if len(places) > 1:
                ours, theirs = _place(field), _place(next(iter(fields.values())))
                raise FormatError(path, f"has {ours}, the first field {theirs}")
    if not fields:
        raise FormatError(sources[0], "has no fields")
    assert field.bounds is not None
    return {name: stored_field.values for name, stored_field in fields.items()}, field.bounds


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
