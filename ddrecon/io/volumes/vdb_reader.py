"""Reading OpenVDB files, through the module `openvdb` (`pyopenvdb` before OpenVDB 11).

Debian and Blender have it, pip has not. Without it, the files that we write can still be read.
"""

from __future__ import annotations

from collections.abc import Collection
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import check_size
from ddrecon.io.volumes.field import Field, check_field
from ddrecon.io.volumes.vdb import RESOLUTION
from ddrecon.io.volumes.vdb_plain import ForeignError, read_plain

MODULES = ("openvdb", "pyopenvdb")
ADVICE = (
    "reading the .vdb of another program needs the Python module openvdb, which pip does not have. "
    "Convert the file to .npz where it is at hand, in Blender's Python or in Debian's (apt-get "
    "install python3-openvdb): docs/formats.md has the line to type"
)
COMPONENTS = {"float": 1, "double": 1, "half": 1, "vec3s": 3, "vec3d": 3}


def vdb_names(path: Path) -> list[str]:
    """The names of the scalar and vector grids of the file at `path`.

    Raises FormatError when it cannot be read.
    """
    module = _module()
    return list(_plain(path) if module is None else _grids(path, module))


def read_vdb(path: Path, name: str) -> Field:
    """The grid `name` of the file at `path`.

    It has the cells that it was written with, or else those of the active voxels of all grids that
    lie as it does. Raises FormatError when it cannot be read, is absent, turned against the axes,
    or not a legal field.
    """
    module = _module()
    if module is None:
        fields = _plain(path)
        _require_grid(path, name, fields)
        return fields[name]
    grids = _grids(path, module)
    _require_grid(path, name, grids)
    grid = grids[name]
    low, high = _cells(path, grid, list(grids.values()))
    components = COMPONENTS[grid.valueTypeName]
    shape = high - low + 1
    check_size(4 * components * int(shape.prod(dtype=object)), path, name)
    values = np.zeros([*shape, components][: 3 if components == 1 else 4], np.float32)
    grid.copyToArray(values, ijk=tuple(low.tolist()))
    return check_field(path, name, values.swapaxes(0, 2), _bounds(grid, low, high))


def _require_grid(path: Path, name: str, grids: Collection[str]) -> None:
    if name not in grids:
        raise FormatError(
            path, f"has no grid {name!r}; it has {', '.join(map(repr, grids)) or 'none'}"
        )


def _grids(path: Path, module: ModuleType) -> dict[str, Any]:
    """The grids by name, but for those of other kinds of values."""
    try:
        grids, _ = module.readAll(str(path))
    except Exception as error:  # OpenVDB's own exceptions are of many kinds
        raise FormatError(path, f"not an OpenVDB file that can be read: {error}") from error
    return {grid.name: grid for grid in grids if grid.valueTypeName in COMPONENTS}


def _module() -> ModuleType | None:
    for name in MODULES:
        try:
            return import_module(name)
        except ImportError:
            continue
    return None


def _plain(path: Path) -> dict[str, Field]:
    """The fields by name of a file that we have written; raises FormatError for any other."""
    try:
        return read_plain(path)
    except ForeignError:
        raise FormatError(path, ADVICE) from None


def _cells(path: Path, grid: Any, others: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    """The indices (x, y, z) of the first and the last cell."""
    active = [
        other
        for other in others
        if other.activeVoxelCount() and np.array_equal(_map(path, other), _map(path, grid))
    ]
    boxes = np.array([other.evalActiveVoxelBoundingBox() for other in active], int).reshape(
        -1, 2, 3
    )
    written = np.array(grid.metadata.get(RESOLUTION, (0, 0, 0)))
    if ((boxes >= 0) & (boxes < written)).all():
        low, high = np.zeros(3, int), written - 1
    else:
        low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
    if (high < low).any():
        raise FormatError(path, f"grid {grid.name!r} is empty")
    return low, high


def _map(path: Path, grid: Any) -> np.ndarray:
    """Index to world as [[scale], [shift]], both (x, y, z).

    Raises FormatError unless cells lie along the axes.
    """
    origin, *ends = (
        np.array(grid.transform.indexToWorld(tuple(place)))
        for place in np.vstack([np.zeros(3), np.eye(3)])
    )
    axes = np.stack(ends) - origin
    scale = np.diagonal(axes)
    if (np.abs(axes - np.diag(scale)) > 1e-6 * np.abs(scale).max()).any() or (scale <= 0).any():
        raise FormatError(
            path,
            f"grid {grid.name!r} is turned, mirrored or in perspective; "
            "resample it along the axes first",
        )
    return np.stack([scale, origin])


def _bounds(grid: Any, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.array(
        [grid.transform.indexToWorld(tuple(corner.tolist())) for corner in (low - 0.5, high + 0.5)]
    )
