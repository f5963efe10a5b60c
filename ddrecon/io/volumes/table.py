"""Volumes by suffix: `FORMATS` is the table; adding a format is one file and one line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.reading import guard_reading
from ddrecon.io.volumes.field import Field, Fields, name_from_file
from ddrecon.io.volumes.mitsuba import read_vol, write_vol
from ddrecon.io.volumes.netcdf import netcdf_names, read_netcdf, write_netcdf
from ddrecon.io.volumes.npz import npz_names, read_npz, write_npz
from ddrecon.io.volumes.tiff_stack import read_stack, write_stack
from ddrecon.io.volumes.vdb import read_vdb, vdb_names, write_vdb
from ddrecon.io.volumes.vti import refuse_vti, write_vti


@dataclass(frozen=True)
class VolumeFormat:
    """How one kind of volume file is read and written.

    By `names(path)`, `read(path, name)` and `write(path, fields, bounds)`. With `has_metadata`,
    `write` takes constants as well.
    """

    names: Callable[[Path], list[str]]
    read: Callable[[Path, str], Field]
    write: Callable[..., None]
    has_metadata: bool = False


FORMATS: dict[str, VolumeFormat] = {
    ".npz": VolumeFormat(npz_names, read_npz, write_npz),
    ".vol": VolumeFormat(name_from_file, read_vol, write_vol),
    ".vdb": VolumeFormat(vdb_names, read_vdb, write_vdb, has_metadata=True),
    ".vti": VolumeFormat(refuse_vti, refuse_vti, write_vti),
    ".nc": VolumeFormat(netcdf_names, read_netcdf, write_netcdf, has_metadata=True),
    **dict.fromkeys((".tif", ".tiff"), VolumeFormat(name_from_file, read_stack, write_stack)),
}


def field_names(path: Path) -> list[str]:
    """The fields that the volume file at `path` holds.

    Raises FormatError when it cannot be read.
    """
    names = _format_of(path).names
    with guard_reading(path):
        return names(path)


def read_field(path: Path, name: str) -> Field:
    """The field `name` (`density`, `sigma_a`, ...) of the volume file at `path`.

    Raises FormatError when it cannot be used.
    """
    read = _format_of(path).read
    with guard_reading(path):
        return read(path, name)


def write_field(path: Path, name: str, values: np.ndarray, bounds: np.ndarray) -> None:
    """Writes `values` [z, y, x] or [z, y, x, 3], as float32, in the format of `path`'s suffix.

    `bounds` [2, 3] are the corners (x, y, z) of the box [u].
    """
    write_fields(path, {name: values}, bounds)


def write_fields(
    path: Path, fields: Fields, bounds: np.ndarray, constants: Fields | None = None
) -> None:
    """Writes several fields of the same cells, by name, each as `write_field` does.

    `constants`, each one number or three, become metadata where `keeps_constants`, else nothing.
    Raises FormatError where the format holds but one field.
    """
    write = _format_of(path).write
    if constants and keeps_constants(path):
        write(path, fields, bounds, constants)
    else:
        write(path, fields, bounds)


def keeps_constants(path: Path) -> bool:
    """Whether the format of the suffix of `path` has metadata for them."""
    return _format_of(path).has_metadata


def _format_of(path: Path) -> VolumeFormat:
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        raise FormatError(
            path, f"unknown volume format {path.suffix!r}; known: {', '.join(FORMATS)}"
        ) from None
