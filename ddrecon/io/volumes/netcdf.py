"""Volumes as netCDF, for atmospheric fields, through `netCDF4` (extra `netcdf`).

A field is a variable on axes x, y and z in any order. An axis is known by the attribute `axis` of
its coordinate (CF conventions), else by its name. Coordinates are centers of cells, evenly spaced,
in the unit of x, which is taken for the scene's unit of length.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.extras import load_for_file
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import NO_FIELDS, Field, Fields, check_field

COLOR = "color"
NAMES = {
    "x": ("x", "west_east", "nx"),
    "y": ("y", "south_north", "ny"),
    "z": ("z", "height", "altitude", "bottom_top", "lev", "nz"),
}
"""What the names of axes begin with."""
METERS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1000.0),
}
EVEN = 0.05
"""How far off even spacing a coordinate may be [cells]: files often round to a few digits."""


def write_netcdf(
    path: Path, fields: Fields, bounds: np.ndarray, constants: Fields = NO_FIELDS
) -> None:
    """Writes `fields`, [z, y, x] or [z, y, x, 3], as float32 variables, and their box.

    `bounds` [2, 3], its corners (x, y, z), are written as coordinates and their bounds; `constants`
    as attributes of the file.
    """
    z, y, x = next(iter(fields.values())).shape[:3]
    box = np.asarray(bounds, np.float64)
    with (
        replace_file(path) as temporary,
        load_for_file("netCDF4", path).Dataset(temporary, "w") as file,
    ):
        file.setncatts({"Conventions": "CF-1.11", **constants})
        for name, count in {"x": x, "y": y, "z": z, "corner": 2, COLOR: 3}.items():
            file.createDimension(name, count)
        for axis, count, low, high in zip("xyz", (x, y, z), *box, strict=True):
            edges = np.linspace(low, high, count + 1)
            centers = file.createVariable(axis, "f8", (axis,))
            corners = file.createVariable(f"{axis}_bounds", "f8", (axis, "corner"))
            told = {"long_name": f"{axis} of cell centers", "bounds": corners.name}
            centers.setncatts({"axis": axis.upper(), **told})
            centers[:] = (edges[:-1] + edges[1:]) / 2
            corners[:] = np.column_stack([edges[:-1], edges[1:]])
        for name, values in fields.items():
            axes = ("z", "y", "x", COLOR)[: values.ndim]
            variable = file.createVariable(name, "f4", axes, compression="zlib", shuffle=True)
            variable[:] = as_float32(values)


def netcdf_names(path: Path) -> list[str]:
    """The variables of the file at `path` that have axes x, y and z.

    Raises FormatError when it cannot be read.
    """
    with load_for_file("netCDF4", path).Dataset(path) as file:
        return _names(file)


def read_netcdf(path: Path, name: str) -> Field:
    """The variable `name` of the file at `path`.

    Raises FormatError when it is damaged, absent, unevenly spaced or not a legal field.
    """
    with load_for_file("netCDF4", path).Dataset(path) as file:
        if name not in file.variables:
            raise FormatError(
                path,
                f"has no variable {name!r}; on axes x, y and z it has "
                f"{', '.join(map(repr, _names(file))) or 'none'}",
            )
        variable = file.variables[name]
        check_size(int(np.prod(variable.shape, dtype=object)) * variable.dtype.itemsize, path, name)
        values, axes = _arrange(path, file, variable)
        sides = [_side(path, file, dimension) for dimension in axes]
    flips = tuple(slice(None, None, step) for step, _ in sides)
    known = [edges for _, edges in sides if edges is not None]
    bounds = np.array(known[::-1]).T if len(known) == 3 else None
    return check_field(path, name, values[flips], bounds)


def _axis_of(file: Any, dimension: str) -> str | None:
    """Which of x, y, z, or color, the `dimension` is."""
    attribute = str(getattr(file.variables.get(dimension), "axis", "")).lower()
    if attribute in NAMES or dimension == COLOR:
        return attribute or COLOR
    return next(
        (axis for axis, names in NAMES.items() if dimension.lower().startswith(names)), None
    )


def _names(file: Any) -> list[str]:
    return [
        name
        for name, variable in file.variables.items()
        if {"x", "y", "z"} <= {_axis_of(file, one) for one in variable.dimensions}
    ]


def _arrange(path: Path, file: Any, variable: Any) -> tuple[np.ndarray, list[str]]:
    """The values as [z, y, x] or [z, y, x, colors], and the names of the dimensions z, y and x.

    Other dimensions must have one entry.
    """
    # What is masked (_FillValue) is NaN, which `check_field` refuses.
    values = np.ma.filled(np.ma.asarray(variable[...], np.float64), np.nan)
    axes = [_axis_of(file, dimension) for dimension in variable.dimensions]
    for axis, dimension, count in zip(axes, variable.dimensions, values.shape, strict=True):
        if axis is None and count > 1:
            raise FormatError(
                path,
                f"{variable.name} has {count} entries along {dimension!r}; "
                f"choose one (ncks -d {dimension},0)",
            )
    order = [axis for axis in ("z", "y", "x", COLOR) if axis in axes]
    if order[:3] != ["z", "y", "x"] or len(order) != len(axes) - axes.count(None):
        raise FormatError(
            path,
            f"{variable.name} has the dimensions {', '.join(variable.dimensions)}; "
            "expected x, y and z: rename them so",
        )
    others = [index for index, axis in enumerate(axes) if axis is None]
    values = values.transpose([*map(axes.index, order), *others])
    known = [variable.dimensions[axes.index(axis)] for axis in "zyx"]
    return values.reshape(values.shape[: len(order)]), known


def _side(path: Path, file: Any, dimension: str) -> tuple[int, np.ndarray | None]:
    """-1 where cells along `dimension` go down, else 1; where they begin and end, if it is said."""
    if dimension not in file.variables:
        return 1, None
    coordinate = file.variables[dimension]
    centers = np.asarray(coordinate[:], np.float64)
    steps = np.diff(centers)
    even = np.linspace(centers[0], centers[-1], len(centers))
    if len(steps) and not np.abs(centers - even).max() <= EVEN * abs(steps.mean()):
        shortest, longest = np.abs(steps).min(), np.abs(steps).max()
        raise FormatError(
            path,
            f"{dimension} is not evenly spaced ({shortest:g} to {longest:g}); "
            "interpolate it first (xarray: .interp)",
        )
    step = -1 if centers[-1] < centers[0] else 1
    # The two ends of a cell come in either order, whichever way the axis goes.
    corners = file.variables.get(getattr(coordinate, "bounds", ""))
    if corners is not None:
        edges = np.asarray(corners[:], np.float64)
    elif len(steps):
        edges = centers[[0, -1]] + steps.mean() / 2 * np.array([-1, 1])
    else:
        return step, None
    return step, np.array([edges.min(), edges.max()]) * _scale(file, coordinate)


def _scale(file: Any, coordinate: Any) -> float:
    """What takes `coordinate` to the unit of the first axis of x; 1 unless both are known."""
    along_x = [name for name in file.dimensions if _axis_of(file, name) == "x"]
    first = next((file.variables[name] for name in along_x if name in file.variables), coordinate)
    units = [METERS.get(str(getattr(one, "units", "")).lower()) for one in (coordinate, first)]
    return units[0] / units[1] if units[0] and units[1] else 1.0
