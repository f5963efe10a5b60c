"""Volumes as float TIFF stacks, for Fiji and napari: a page a slice across z.

Row 0 is at the lowest y, and colors are three channels. Laid out as ImageJ's hyperstacks, through
`tifffile` (extra `tiff`). A file holds one field, without a name. Its box is in ImageJ's
calibration, and in full precision in an entry `bounds` of its description.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.extras import load_for_file
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.files.reading import guard_reading
from ddrecon.io.volumes.field import Field, Fields, check_field, require_only_field

MARK = "bounds"
"""What the description of a stack that we wrote says, besides what ImageJ says."""


def write_stack(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes the one of `fields`, [z, y, x] or [z, y, x, 3], as float32, and its box.

    `bounds` [2, 3] are the corners (x, y, z) [u]. The format knows no names.
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
    """The field in the file at `path`, taken for `name`.

    Raises FormatError when it is damaged or not a legal field.
    """
    with open_tiff(path) as file:
        series = file.series[0]
        check_size(series.size * series.dtype.itemsize, path, "the stack")
        values = _slices(path, series.asarray(), series.axes)
        bounds = _bounds(file, values.shape[2::-1])
    return check_field(path, name, values, bounds)


def _slices(path: Path, values: np.ndarray, axes: str) -> np.ndarray:
    """`values` as [z, y, x] or [z, y, x, colors].

    `axes` are tifffile's letters, of which C (channels) and S (samples) are colors.
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
            f"has the axes {axes}; "
            "expected slices (Z), rows (Y) and columns (X), and colors if any",
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


def is_stack(path: Path) -> bool:
    """Whether the TIFF file at `path` is a volume: of several pages, or written as one by us."""
    with guard_reading(path), open_tiff(path) as file:
        return _is_stack(file)


@contextmanager
def open_tiff(path: Path) -> Iterator[Any]:
    """The `tifffile.TiffFile` at `path`, for a block that reads it.

    Raises FormatError for damage that tifffile only logs: it takes the pages before a cut for all.
    """
    tifffile = load_for_file("tifffile", path)
    errors: list[str] = []

    def keep_errors(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.ERROR:
            errors.append(record.getMessage())
        return False

    logger = logging.getLogger("tifffile")
    logger.addFilter(keep_errors)
    try:
        with tifffile.TiffFile(path) as file:
            yield file
    except (KeyError, ValueError) as error:
        if "imagecodecs" in str(error):
            raise FormatError(path, f"cannot be read: {error}; save it uncompressed") from error
        raise
    finally:
        logger.removeFilter(keep_errors)
    if errors:
        raise FormatError(path, f"is damaged: {errors[0]}")


def _is_stack(file: Any) -> bool:
    facts = file.imagej_metadata or {}
    return len(file.pages) > 1 or facts.get("images", 1) > 1 or MARK in facts
