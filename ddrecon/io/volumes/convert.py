"""Volumes from several files put together, and turned for programs whose up is z."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.volumes.field import BOX, Field, Fields
from ddrecon.io.volumes.table import field_names, read_field


def read_together(sources: Sequence[Path]) -> tuple[Fields, np.ndarray]:
    """All fields of the volumes `sources`, and their box.

    Raises FormatError for volumes of different cells or boxes, and for none at all.
    """
    fields: dict[str, Field] = {}
    for path in sources:
        for name in field_names(path):
            if name in fields:
                raise FormatError(path, f"has a field {name!r}, and so has a file before it")
            fields[name] = read_field(path, name)
            _require_same_cells(path, fields[name], next(iter(fields.values())))
    if not fields:
        raise FormatError(sources[0], "has no fields")
    values = {name: field.values for name, field in fields.items()}
    return values, _bounds(sources[0], next(iter(fields.values())))


def raise_z(fields: Fields, bounds: np.ndarray) -> tuple[Fields, np.ndarray]:
    """`fields` and their box turned so that z points up where y did: (x, y, z) is (x, -z, y)."""
    (x, y, z), (far_x, far_y, far_z) = bounds.tolist()
    box = np.array([[x, -far_z, y], [far_x, -z, far_y]])
    return {name: values.swapaxes(0, 1)[:, ::-1] for name, values in fields.items()}, box


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
