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
            field = fields[name] = read_field(path, name)
            if field.bounds is None:
                raise FormatError(path, f'says no box; add an array "bounds", {BOX}')
            places = {_place(each) for each in fields.values()}
            if len(places) > 1:
                ours, theirs = _place(field), _place(next(iter(fields.values())))
                raise FormatError(path, f"has {ours}, the first field {theirs}")
    if not fields:
        raise FormatError(sources[0], "has no fields")
    assert field.bounds is not None
    return {name: each.values for name, each in fields.items()}, field.bounds


def _place(field: Field) -> str:
    cells = " x ".join(map(str, field.resolution))
    return f"{cells} cells (x, y, z) in the box {np.asarray(field.bounds).tolist()}"


def raise_z(fields: Fields, bounds: np.ndarray) -> tuple[Fields, np.ndarray]:
    """`fields` and their box turned so that z points up where y did: (x, y, z) is (x, -z, y)."""
    (x, y, z), (far_x, far_y, far_z) = bounds.tolist()
    box = np.array([[x, -far_z, y], [far_x, -z, far_y]])
    return {name: values.swapaxes(0, 1)[:, ::-1] for name, values in fields.items()}, box
