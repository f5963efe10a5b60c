"""Volumes as float TIFF stacks, for Fiji and napari: a page a slice across z, row 0 at the lowest
y, three channels for colors.

Laid out as ImageJ's hyperstacks, through `tifffile` (extra `tiff`). A file holds one field, without
a name. Its box is in ImageJ's calibration, and in full precision in an entry `bounds` of its
description.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.extras import load_for_file
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.images.tiff import MARK
from ddrecon.io.volumes.field import Field, Fields, check_field, require_only_field


def write_stack(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes the one of `fields`, [z, y, x] or [z, y, x, 3], as float32, and `bounds` [2, 3] (x, y,
    z); the format knows no names.
    """
    tifffile = load_for_file("tifffile", path)
    values = as_float32(require_only_field(path, fields))
    low, high = np.asarray(bounds, np.float64)
    size = (high - low) / values.shape[2::-1]
    origin = {
        f"{axis}origin": float(number) for axis, number in zip("xyz", -low / size, strict=True)
    }
    facts: dict[str, Any] = {"axes": "TZCYXS", "spacing": float(size[2]), "unit": "u", **origin}
    facts[MARK] = json.dumps([low.tolist(), high.tolist()])
    pages = (values[:, None] if values.ndim == 3 else np.moveaxis(values, 3, 1))[None, ..., None]
    with replace_file(path) as temporary:
        tifffile.imwrite(
            temporary,
            pages,
            imagej=True,
            photometric="minisblack",
            resolution=tuple(1 / size[:2]),
            metadata=facts,
        )


def read_stack(path: Path, name: str) -> Field:
    """The field in the file at `path`, taken for `name`; raises FormatError when it is damaged or
    not a legal field.
    """
    tifffile = load_for_file("tifffile", path)
    logging.getLogger("tifffile").setLevel(
        logging.CRITICAL
    )  # what it has to say of damage, our errors do
    try:
        with tifffile.TiffFile(path) as file:
            series = file.series[0]
            check_size(series.size * series.dtype.itemsize, path, "the stack")
            values = _slices(path, series.asarray(), series.axes)
            bounds = _bounds(file, values.shape[2::-1])
    except FormatError:
        raise
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
    except Exception as error:  # decoders of damaged files raise whatever they like
        raise FormatError(path, f"not a TIFF stack that can be read: {error}") from error
    return check_field(path, name, values, bounds)


def _slices(path: Path, values: np.ndarray, axes: str) -> np.ndarray:
    """`values` as [z, y, x] or [z, y, x, colors]; `axes` are tifffile's letters, of which C and S
    are colors.
    """
    if values.dtype.kind not in "fiub":
        raise FormatError(path, f"holds values of type {values.dtype}; save it as 32-bit float")
    for index, letter in enumerate(axes):
        if letter in "CS":
            values, axes = np.moveaxis(values, index, -1), axes.replace(letter, "")
            break
    if axes[-2:] != "YX" or len(axes) > 3:
        raise FormatError(
            path,
            f"has the axes {axes}; expected slices (Z), rows (Y) and columns (X), and colors if any",
        )
    return values if len(axes) == 3 else values[None]


def _bounds(file: Any, cells: tuple[int, ...]) -> np.ndarray | None:
    """The corners as the description says them, else by ImageJ's calibration, else unknown."""
    facts = file.imagej_metadata or {}
    if MARK in facts:
        return np.array(json.loads(facts[MARK]), np.float64)
    if "spacing" not in facts:
        return None
    tags = file.pages[0].tags
    per_unit = [
        tags[name].value if name in tags else (1, 1) for name in ("XResolution", "YResolution")
    ]
    size = np.array([*(below / above for above, below in per_unit), facts["spacing"]])
    low = -size * [facts.get(f"{axis}origin", 0) for axis in "xyz"]
    return np.stack([low, low + size * cells])
