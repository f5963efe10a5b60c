"""netCDF: axes told by CF attributes or by name, in any order, direction and unit of length."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refusal

from ddrecon.errors import FormatError
from ddrecon.io.volumes.table import read_field, write_field

netcdf = pytest.importorskip("netCDF4", reason="netCDF needs netCDF4 (the extra `netcdf`)")
BOUNDS = np.array([[-1.0, -2.0, 6.0], [1.0, 2.5, 9.0]])
VALUES = np.random.default_rng(0).random((3, 5, 4)).astype(np.float32)
CENTERS = {"x": [-0.75, -0.25, 0.25, 0.75], "y": [-1.55, -0.65, 0.25, 1.15, 2.05]}
CENTERS["z"] = [6.5, 7.5, 8.5]
Axis = tuple[Any, dict[str, str]]
"""The numbers of a coordinate, and its attributes."""


def written(
    path: Path, values: np.ndarray, dimensions: str, kind: str = "NETCDF4", **axes: Axis
) -> Path:
    """A file with `QN` on `dimensions`, and a coordinate and its attributes for each of `axes`."""
    with netcdf.Dataset(path, "w", format=kind) as file:
        for name, count in zip(dimensions.split(), values.shape, strict=True):
            file.createDimension(name, count)
        for name, (numbers, attributes) in axes.items():
            coordinate = file.createVariable(name, "f8", (name,))
            coordinate[:] = numbers
            coordinate.setncatts(attributes)
        file.createVariable("QN", "f4", tuple(dimensions.split()))[:] = values
    return path


def plain(**units: str) -> dict[str, Axis]:
    """Coordinates called x, y and z, in these units."""
    axes = {axis: (np.array(CENTERS[axis]), {}) for axis in "xyz"}
    for axis, unit in units.items():
        axes[axis] = axes[axis][0] / (1000 if unit == "km" else 1), {"units": unit}
    return axes


@pytest.mark.parametrize("order", ["z y x", "x y z", "y z x", "time z y x"])
def test_axes_come_in_any_order(tmp_path: Path, order: str) -> None:
    places = ["zyx".index(name) for name in order.split() if name != "time"]
    values = VALUES.transpose(places)
    values = values[None] if order.startswith("time") else values
    kind = "NETCDF3_CLASSIC" if order == "x y z" else "NETCDF4"
    field = read_field(written(tmp_path / "f.nc", values, order, kind, **plain()), "QN")
    assert np.array_equal(field.values, VALUES) and np.allclose(field.bounds, BOUNDS)


def test_axes_are_told_by_attribute_before_name(tmp_path: Path) -> None:
    names = {"y": "x", "north": "y", "height": "z"}
    axes = {name: (CENTERS[axis], {"axis": axis.upper()}) for name, axis in names.items()}
    field = read_field(written(tmp_path / "f.nc", VALUES, "height north y", **axes), "QN")
    assert np.array_equal(field.values, VALUES) and np.allclose(field.bounds, BOUNDS)


METERS, KILOMETERS = {"x": "m", "y": "m", "z": "km"}, {"x": "km", "y": "km", "z": "m"}


@pytest.mark.parametrize(("units", "scale"), [(METERS, 1), (KILOMETERS, 1e-3), ({"z": "km"}, None)])
def test_heights_are_in_the_unit_of_x(tmp_path: Path, units: dict, scale: float | None) -> None:
    """Where both say one; else numbers are taken as they stand."""
    field = read_field(written(tmp_path / "f.nc", VALUES, "z y x", **plain(**units)), "QN")
    expected = BOUNDS * scale if scale else BOUNDS * [1, 1, 1e-3]
    assert np.allclose(field.bounds, expected, rtol=1e-12)


@pytest.mark.parametrize("order", [0, 1, -1])
def test_downward_axes_are_turned(tmp_path: Path, order: int) -> None:
    """As pressure levels are; the ends of a cell, where they are said, come in either order."""
    axes = plain() | {"z": (CENTERS["z"][::-1], {})}
    path = written(tmp_path / "f.nc", VALUES[::-1], "z y x", **axes)
    if order:
        with netcdf.Dataset(path, "a") as file:
            file.createDimension("corner", 2)
            file.variables["z"].bounds = "z_bounds"
            ends = np.array(CENTERS["z"][::-1])[:, None] + [-0.5, 0.5]
            file.createVariable("z_bounds", "f8", ("z", "corner"))[:] = ends[:, ::order]
    field = read_field(path, "QN")
    assert np.array_equal(field.values, VALUES) and np.allclose(field.bounds, BOUNDS)


def test_a_file_without_coordinates_has_no_box(tmp_path: Path) -> None:
    field = read_field(written(tmp_path / "f.nc", VALUES, "bottom_top south_north west_east"), "QN")
    assert np.array_equal(field.values, VALUES) and field.bounds is None


def test_what_does_not_fit_is_refused_with_advice(tmp_path: Path) -> None:
    path = tmp_path / "f.nc"
    with pytest.raises(FormatError, match=r"read, not written: take \.npz"):
        write_field(path, "density", VALUES, BOUNDS)
    told = refusal(written(path, VALUES, "z y x", **plain()))
    assert told == "has no field 'density'; it has 'QN'; say name: QN beside file"
    stretched, twice = plain() | {"z": ([6.5, 7.5, 9.0], {})}, np.stack([VALUES] * 2)
    holes = np.ma.masked_less(VALUES, VALUES.max())
    for values, dimensions, axes, told in (
        (twice, "time z y x", {}, "QN has 2 entries along 'time'; choose one"),
        (VALUES[:1], "a y x", {}, "has the dimensions a, y, x; name some of them x, y and z"),
        (VALUES, "z y x", stretched, "z is not evenly spaced (1 to 1.5); interpolate it first"),
        (holes, "z y x", {}, "QN is NaN"),
    ):
        assert told in refusal(written(path, values, dimensions, **axes), "QN")
