"""Volumes from one format into another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.folders import require_free_files
from ddrecon.io.volumes.field import BOX, Field
from ddrecon.io.volumes.table import field_names, read_field, require_format, write_fields


def convert(sources: Sequence[Path], output: Path, *, may_exist: bool) -> list[Path]:
    """Writes all fields of the volumes `sources` to `output`, in the format of its suffix.

    Returns what was written. Raises UsageError where `output` is there and may not be or its folder
    is missing, FormatError for volumes of different cells or boxes, and for none at all.
    """
    require_format(output)
    require_free_files([output], may_exist=may_exist)
    fields: dict[str, Field] = {}
    for path in sources:
        for name in field_names(path):
            if name in fields:
                raise FormatError(path, f"has a field {name!r}, and so has a file before it")
            fields[name] = read_field(path, name)
            _require_same_cells(path, fields[name], next(iter(fields.values())))
    if not fields:
        raise FormatError(sources[0], "has no fields")
    write_fields(
        output,
        {name: field.values for name, field in fields.items()},
        _bounds(sources[0], next(iter(fields.values()))),
    )
    return [output]


def _require_same_cells(path: Path, field: Field, first: Field) -> None:
    if field.resolution != first.resolution:
        ours, theirs = (" x ".join(map(str, each.resolution)) for each in (field, first))
        raise FormatError(path, f"has {ours} cells (x, y, z), the first field {theirs}")
    box, first_box = _bounds(path, field), _bounds(path, first)
    if not np.array_equal(box, first_box):
        raise FormatError(
            path, f"lies in the box {box.tolist()}, the first field in {first_box.tolist()}"
        )


def _bounds(path: Path, field: Field) -> np.ndarray:
    if field.bounds is None:
        raise FormatError(path, f'says no box; add an array "bounds", {BOX}')
    return field.bounds
