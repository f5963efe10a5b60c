"""Atmospheric fields in netCDF, read through `netCDF4` (extra `netcdf`).

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
from ddrecon.io.files.arrays import check_size
from ddrecon.io.volumes.field import Field, check_field

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


def netcdf_names(path: Path) -> list[str]:
    """The variables of the file at `path` that have axes x, y and z; there must be some."""
    with load_for_file("netCDF4", path).Dataset(path) as file:
        names = [
            name
            for name, variable in file.variables.items()
            if set("xyz") <= {_axis_of(file, dimension) for dimension in variable.dimensions}
        ]
        if not names:
            axes = ", ".join(file.dimensions)
            raise FormatError(path, f"has the dimensions {axes}; name some of them x, y and z")
        return names


def read_netcdf(path: Path, name: str) -> Field:
    """The variable `name` of the file at `path`.

    Raises FormatError when it is damaged, unevenly spaced or not a legal field.
    """
    with load_for_file("netCDF4", path).Dataset(path) as file:
        variable = file.variables[name]
        check_size(int(np.prod(variable.shape, dtype=object)) * variable.dtype.itemsize, path, name)
        # What is masked (_FillValue) is NaN, which `check_field` refuses.
        values = np.ma.filled(np.ma.asarray(variable[...], np.float64), np.nan)
        axes = dict[str, str]()
        for dimension, count in zip(variable.dimensions, values.shape, strict=True):
            axis = _axis_of(file, dimension)
            if axis and axis not in axes:
                axes[axis] = dimension
            elif count > 1:
                advice = f"choose one (ncks -d {dimension},0)"
                raise FormatError(path, f"{name} has {count} entries along {dimension!r}; {advice}")
        kept = [axes[axis] for axis in "zyx"]
        order = sorted(variable.dimensions, key=lambda one: [*kept, one].index(one))
        values = values.transpose([variable.dimensions.index(one) for one in order])
        sides = [_side(path, file, dimension) for dimension in kept]
    flips = tuple(slice(None, None, step) for step, _ in sides)
    known = [edges for _, edges in sides if edges is not None]
    bounds = np.array(known[::-1]).T if len(known) == 3 else None
    return check_field(path, name, values.reshape(values.shape[:3])[flips], bounds)


def _axis_of(file: Any, dimension: str) -> str | None:
    """Which of x, y and z the `dimension` is."""
    attribute = str(getattr(file.variables.get(dimension), "axis", "")).lower()
    if attribute in NAMES:
        return attribute
    return next(
        (axis for axis, names in NAMES.items() if dimension.lower().startswith(names)), None
    )


def _side(path: Path, file: Any, dimension: str) -> tuple[int, np.ndarray | None]:
    """-1 where cells along `dimension` go down, else 1; where they begin and end, if it is said."""
    if dimension not in file.variables:
        return 1, None
    coordinate = file.variables[dimension]
    centers = np.asarray(coordinate[:], np.float64)
    steps = np.diff(centers)
    even = np.linspace(centers[0], centers[-1], len(centers))
    if len(steps) and not np.abs(centers - even).max() <= EVEN * abs(steps.mean()):
        spacing = f"{np.abs(steps).min():g} to {np.abs(steps).max():g}"
        advice = "interpolate it first (xarray: .interp)"
        raise FormatError(path, f"{dimension} is not evenly spaced ({spacing}); {advice}")
    step = -1 if centers[-1] < centers[0] else 1
    # The two ends of a cell come in either order, whichever way the axis goes.
    corners = file.variables.get(getattr(coordinate, "bounds", ""))
    if corners is not None:
        edges = np.asarray(corners[:], np.float64)
    elif len(steps):
        edges = centers[[0, -1]] + steps.mean() / 2 * np.array([-1, 1])
    else:
        return step, None
    # In the unit of the first axis of x, where both are known.
    along_x = [name for name in file.dimensions if _axis_of(file, name) == "x"]
    first = next((file.variables[name] for name in along_x if name in file.variables), coordinate)
    own, unit = (METERS.get(str(getattr(one, "units", "")).lower()) for one in (coordinate, first))
    scale = own / unit if own and unit else 1.0
    return step, np.array([edges.min(), edges.max()]) * scale
