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
from ddrecon.io.volumes.vdb import write_vdb
from ddrecon.io.volumes.vdb_reader import read_vdb, vdb_names
from ddrecon.io.volumes.vti import read_vti, vti_names, write_vti


@dataclass(frozen=True)
class VolumeFormat:
    """How one kind of volume file is read and written: `names(path)`, `read(path, name)`,
    `write(path, fields, bounds)`.
    """

    names: Callable[[Path], list[str]]
    read: Callable[[Path, str], Field]
    write: Callable[[Path, Fields, np.ndarray], None]


FORMATS: dict[str, VolumeFormat] = {
    ".npz": VolumeFormat(npz_names, read_npz, write_npz),
    ".vol": VolumeFormat(name_from_file, read_vol, write_vol),
    ".vdb": VolumeFormat(vdb_names, read_vdb, write_vdb),
    ".vti": VolumeFormat(vti_names, read_vti, write_vti),
    ".nc": VolumeFormat(netcdf_names, read_netcdf, write_netcdf),
    **dict.fromkeys((".tif", ".tiff"), VolumeFormat(name_from_file, read_stack, write_stack)),
}


def field_names(path: Path) -> list[str]:
    """The fields that the volume file at `path` holds; raises FormatError when it cannot be read."""
    names = _format_of(path).names
    with guard_reading(path):
        return names(path)


def read_field(path: Path, name: str) -> Field:
    """The field `name` (`density`, `sigma_a`, ...) of the volume file at `path`; raises FormatError
    when it cannot be used.
    """
    read = _format_of(path).read
    with guard_reading(path):
        return read(path, name)


def write_field(path: Path, name: str, values: np.ndarray, bounds: np.ndarray) -> None:
    """Writes `values` [z, y, x] or [z, y, x, 3] and `bounds` [2, 3] (x, y, z) in the format of
    `path`'s suffix, as float32.
    """
    write_fields(path, {name: values}, bounds)


def write_fields(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes several fields of the same cells, by name, each as `write_field`; raises FormatError
    where the format holds but one.
    """
    _format_of(path).write(path, fields, bounds)


def require_format(path: Path) -> None:
    """Raises FormatError where the suffix of `path` is none of those in `FORMATS`."""
    _format_of(path)


def _format_of(path: Path) -> VolumeFormat:
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        raise FormatError(
            path, f"unknown volume format {path.suffix!r}; known: {', '.join(FORMATS)}"
        ) from None
