"""Atmospheric fields in netCDF, read through `netCDF4` (extra `netcdf`).

A field is a variable on axes x, y and z in any order, in any group. An axis is known by what its
coordinate says (CF conventions), else by its name. Coordinates are centers of cells, evenly spaced,
in the unit of x, which is taken for the scene's unit of length.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.extras import load_extra
from ddrecon.io.files.reading import check_size
from ddrecon.io.volumes.field import METERS, Field, check_field, size_of

LEVELS = "[pim]?lev|(model|pressure)_?lev|(air_)?pres|p$|isobaric|sigma|eta$|hybrid|atmosphere_"
"""How the names of axes begin that are no length but pressures, or numbers of levels."""
NAMES = {
    "t": ".*time",
    "x": "n?x|n?i(p1)?$|ni_|west_east|easting|projection_x|(grid_|r)?lon",
    "y": "n?y(?!r|ear)|n?j(p1)?$|nj_|south_north|northing|projection_y|(grid_|r)?lat",
    "z": f"n?z(?!en)|n?k(p1)?$|nk_|bottom_top|height|alt|depth|{LEVELS}",
}
"""How the names of axes begin."""
EVEN = 0.05
"""How far off even spacing a coordinate may be [cells]: files often round to a few digits."""


Coordinates = Mapping[str, Any]
"""Variables that say where cells lie, by dimension."""


class _Side(NamedTuple):
    """Cells along a dimension: `step` is -1 where they go down, else 1; `ends` [2] are where they
    begin and end, in units of `meters`, where the file says so.
    """

    step: int = 1
    ends: np.ndarray | None = None
    meters: float | None = None


def netcdf_names(path: Path) -> list[str]:
    """The variables of the file at `path` that have axes x, y and z; there must be some."""
    with load_extra("netCDF4", path).Dataset(path) as file:
        axes = {name: _axes(variable, seen) for name, variable, seen in _variables(file)}
        names = [name for name in axes if set("xyz") <= set(axes[name].values())]
        if not names:
            sides = ", ".join(dict.fromkeys(chain.from_iterable(axes.values())))
            raise FormatError(path, f"has the dimensions {sides}; name some of them x, y and z")
        return names


def _variables(
    group: Any, prefix: str = "", above: Coordinates | None = None
) -> Iterator[tuple[str, Any, Coordinates]]:
    """The path of each variable in `group`, itself, and the coordinates that it sees.

    A coordinate has the name of its dimension, or else is the only length along it alone; those
    `above` are of dimensions of groups around this one.
    """
    coordinates = {n: c for n, c in (above or {}).items() if n not in group.dimensions}
    lengths, variables = dict[str, list[Any]](), dict[str, Any]()
    for name, variable in group.variables.items():
        if not np.issubdtype(variable.dtype, np.number):
            continue
        if name in variable.dimensions:
            coordinates[name] = variable
            continue
        variables[name] = variable
        if variable.ndim == 1 and size_of(_says(variable, "units"), METERS) is not None:
            axis, (along,) = _axis_of(name, variable), variable.dimensions
            if axis and _axis_of(along, None) in ("", axis):
                lengths.setdefault(along, []).append(variable)
    single = {along: only for along, (only, *more) in lengths.items() if not more}
    coordinates = single | coordinates
    for name, variable in variables.items():
        yield prefix + name, variable, coordinates
    for name, inner in group.groups.items():
        yield from _variables(inner, f"{prefix}{name}/", coordinates)


def read_netcdf(path: Path, name: str) -> Field:
    """The variable `name` of the file at `path`, with its unit.

    Raises FormatError when it is damaged, unevenly spaced or not a legal field.
    """
    with load_extra("netCDF4", path).Dataset(path) as file:
        variable, coordinates = next(entry[1:] for entry in _variables(file) if entry[0] == name)
        values, axes = _numbers(path, variable), dict[str, str]()
        sizes = dict(zip(variable.dimensions, values.shape, strict=True))
        axes_of_variable = _axes(variable, coordinates)
        for dimension in sorted(axes_of_variable, key=lambda side: -sizes[side]):
            axis = axes_of_variable[dimension]
            if axis in [*"xyz"] and axis not in axes:
                axes[axis] = dimension
            elif sizes[dimension] != 1:
                text = f"{name} has {sizes[dimension]} entries along {dimension!r}"
                raise FormatError(path, f"{text}; choose one (ncks -d {dimension},0)")
        first = [axes[axis] for axis in "zyx"]
        order = sorted(variable.dimensions, key=lambda side: [*first, side].index(side))
        values = values.transpose([variable.dimensions.index(side) for side in order])
        sides = {
            axes[axis]: _side(path, axis, axes[axis], coordinates.get(axes[axis])) for axis in "xyz"
        }
        bounds, unit = _box(path, sides), _says(variable, "units")
    flips = tuple(slice(None, None, sides[axes[axis]].step) for axis in "zyx")
    values = values.reshape(values.shape[:3])[flips]
    meters = None if bounds is None else sides[axes["x"]].meters
    return replace(check_field(path, name, values, bounds), unit=unit, meters=meters)


def _numbers(path: Path, variable: Any) -> np.ndarray:
    """The values of `variable`, NaN where masked (_FillValue), which `check_field` refuses."""
    size = int(np.prod(variable.shape, dtype=object)) * variable.dtype.itemsize
    check_size(size, path, variable.name)
    return np.ma.filled(np.ma.asarray(variable[...], np.float64), np.nan)


def _says(variable: Any, attribute: str) -> str:
    return str(getattr(variable, attribute, "")).strip()


def _axes(variable: Any, coordinates: Coordinates) -> dict[str, str]:
    """Which of x, y, z and t each dimension of `variable` is, "" where that is unknown."""
    return {name: _axis_of(name, coordinates.get(name)) for name in variable.dimensions}


def _axis_of(dimension: str, coordinate: Any) -> str:
    axis = _says(coordinate, "axis").lower()
    if axis in NAMES:
        return axis
    if " since " in _says(coordinate, "units"):
        return "t"
    if _says(coordinate, "positive"):
        return "z"
    names = _says(coordinate, "standard_name"), dimension, _says(coordinate, "name")
    return next((a for name in names for a, begins in NAMES.items() if _begins(name, begins)), "")


def _begins(name: str, pattern: str) -> bool:
    return re.match(pattern, name, re.IGNORECASE) is not None


def _side(path: Path, axis: str, dimension: str, coordinate: Any) -> _Side:
    """Where cells lie along the `axis`, a `dimension`, by its `coordinate`; raises FormatError."""
    unit, positive = _says(coordinate, "units"), _says(coordinate, "positive").lower()
    meters, names = size_of(unit, METERS), (_says(coordinate, "standard_name"), dimension)
    is_depth = not positive and any(_begins(name, "depth") for name in names)
    are_levels = any(_begins(name, LEVELS) for name in names) or (is_depth and coordinate is None)
    if meters is None and (unit or (are_levels and axis == "z")):
        fault = f"is in {unit}, which is no known length" if unit else "says no unit of length"
        drop = f"leave it out (ncks -C -x -v {dimension}) and say volume.bounds"
        advice = "interpolate to heights in m" if axis == "z" else f"project it to m, or {drop}"
        raise FormatError(path, f"{dimension} {fault}; {advice}")
    if coordinate is None:
        return _Side()
    centers = _centers(path, coordinate, dimension)
    if is_depth and centers.min() < 0:
        advice = f"say which way it counts (ncatted -a positive,{dimension},o,c,up)"
        raise FormatError(path, f"{dimension} has depths below 0; {advice}")
    sign = -1 if axis == "z" and (is_depth or positive.startswith("down")) else 1
    step = sign * (-1 if centers[-1] < centers[0] else 1)
    # The two ends of a cell come in either order, whichever way the axis goes.
    corners, ends = coordinate.group().variables.get(_says(coordinate, "bounds")), None
    if corners is not None:
        ends = _numbers(path, corners)
    elif len(centers) > 1:
        half = (centers[-1] - centers[0]) / (len(centers) - 1) / 2
        ends = np.array([centers[0] - half, centers[-1] + half])
    if ends is not None:
        ends = np.sort([sign * ends.min(), sign * ends.max()]) + 0.0
    return _Side(step, ends, meters)


def _centers(path: Path, coordinate: Any, dimension: str) -> np.ndarray:
    """The centers of cells along `dimension`; raises FormatError where they are no even profile."""
    numbers = _numbers(path, coordinate)
    columns = np.moveaxis(numbers, coordinate.dimensions.index(dimension), 0)
    columns = columns.reshape(len(columns), -1)
    centers = columns.mean(1)
    steps, even = np.diff(centers), np.linspace(centers[0], centers[-1], len(centers))
    reason = None
    if np.ptp(columns, 1).max() > EVEN * np.abs(steps).min(initial=np.inf):
        reason = "differs from column to column"
    elif len(steps) and not np.abs(centers - even).max() <= EVEN * abs(steps.mean()):
        spacing = f"{np.abs(steps).min():g} to {np.abs(steps).max():g}"
        reason = f"is not evenly spaced ({spacing})"
    if reason:
        raise FormatError(path, f"{dimension} {reason}; interpolate it first (xarray: .interp)")
    return centers


def _box(path: Path, sides: Mapping[str, _Side]) -> np.ndarray | None:
    """The corners of the box [2, 3], in the unit of x, where the file says all `sides`."""
    _, ends, meters = zip(*sides.values(), strict=True)
    if any(end is None for end in ends):
        return None
    silent = [dimension for dimension, side in sides.items() if side.meters is None]
    if 0 < len(silent) < len(sides):
        advice = f"say it (ncatted -a units,{silent[0]},o,c,m)"
        raise FormatError(path, f"{silent[0]} says no unit of length, others do; {advice}")
    return np.stack(ends, 1) * (1.0 if silent else np.divide(meters, meters[0]))
