"""netCDF: axes told by CF attributes or by name, in any order, direction and unit of length."""

import numpy as np
import pytest
from refusals import refusal

from ddrecon.errors import FormatError
from ddrecon.io.volumes.table import field_names, read_field, write_field

netcdf = pytest.importorskip("netCDF4", reason="netCDF needs netCDF4 (the extra `netcdf`)")
BOUNDS = np.array([[-1.0, -2.0, 6.0], [1.0, 2.5, 9.0]])
VALUES = np.random.default_rng(0).random((3, 5, 4)).astype(np.float32)
CENTERS = {"x": [-0.75, -0.25, 0.25, 0.75], "y": [-1.55, -0.65, 0.25, 1.15, 2.05]}
CENTERS["z"] = [6.5, 7.5, 8.5]


def written(path, values, dimensions, kind="NETCDF4", **axes):
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


def plain(**units):
    """Coordinates called x, y and z, in these units."""
    axes = {axis: (np.array(CENTERS[axis]), {}) for axis in "xyz"}
    for axis, unit in units.items():
        axes[axis] = axes[axis][0] / (1000 if unit == "km" else 1), {"units": unit}
    return axes


@pytest.mark.parametrize("order", ["z y x", "x y z", "y z x", "time z y x"])
def test_axes_come_in_any_order(tmp_path, order):
    places = ["zyx".index(name) for name in order.split() if name != "time"]
    values = VALUES.transpose(places)
    values = values[None] if order.startswith("time") else values
    kind = "NETCDF3_CLASSIC" if order == "x y z" else "NETCDF4"
    field = read_field(written(tmp_path / "f.nc", values, order, kind, **plain()), "QN")
    assert np.array_equal(field.values, VALUES) and np.allclose(field.bounds, BOUNDS)


def test_axes_are_told_by_attribute_before_name(tmp_path):
    names = {"y": "x", "north": "y", "height": "z"}
    axes = {name: (CENTERS[axis], {"axis": axis.upper()}) for name, axis in names.items()}
    field = read_field(written(tmp_path / "f.nc", VALUES, "height north y", **axes), "QN")
    assert np.array_equal(field.values, VALUES) and np.allclose(field.bounds, BOUNDS)


@pytest.mark.parametrize(
    ("units", "scale"),
    [
        ({"x": "m", "y": "meters", "z": "km"}, 1),
        ({"x": "km", "y": "m above sea level", "z": "Metre"}, 1e-3),
        ({"x": "", "y": ""}, 1),
    ],
)
def test_lengths_are_in_the_unit_of_x(tmp_path, units, scale):
    field = read_field(written(tmp_path / "f.nc", VALUES, "z y x", **plain(**units)), "QN")
    assert np.allclose(field.bounds, BOUNDS * scale, rtol=1e-12)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(
    ("name", "attributes"),
    [
        ("z", {"positive": "down"}),
        ("lev", {"positive": " Downward", "units": "m"}),
        ("depth", {}),
        ("floor", {"standard_name": "depth", "units": "m"}),
    ],
)
def test_depths_are_heights_below_0(tmp_path, name, attributes, order):
    unit = attributes.get("units", "")
    axes = plain(x=unit, y=unit)
    del axes["z"]
    axes[name] = np.array(CENTERS["z"])[::-order], attributes
    field = read_field(written(tmp_path / "f.nc", VALUES[::order], f"{name} y x", **axes), "QN")
    assert np.array_equal(field.values, VALUES)
    assert np.allclose(field.bounds, [[-1, -2, -9], [1, 2.5, -6]])


@pytest.mark.parametrize(
    "names",
    [("nk", "nj", "ni"), ("nz", "ny", "nx"), ("bottom_top", "south_north", "west_east")],
)
def test_coordinates_may_have_other_names_and_stand_in_groups(tmp_path, names):
    """A profile of another quantity along an axis, or a length across it, is no coordinate."""
    path = tmp_path / "f.nc"
    with netcdf.Dataset(path, "w") as file:
        for axis, name in zip("zyx", names, strict=True):
            file.createDimension(name, len(CENTERS[axis]))
            for other, unit in (
                (f"{axis}h", "km"),
                (f"{axis}rate", "s-1"),
                ("abc"["xyz".index(axis)], "km"),
            ):
                variable = file.createVariable(other, "f8", (name,))
                variable[:], variable.units = CENTERS[axis], unit
        inner = file.createGroup("fields").createGroup("water")
        inner.createVariable("QN", "f4", names)[:] = VALUES
    assert field_names(path) == ["fields/water/QN"]
    field = read_field(path, "fields/water/QN")
    assert np.array_equal(field.values, VALUES) and np.allclose(field.bounds, BOUNDS)


def test_a_group_may_have_dimensions_of_the_same_names(tmp_path):
    path = written(tmp_path / "f.nc", VALUES, "z y x", **plain())
    with netcdf.Dataset(path, "a") as file:
        inner = file.createGroup("finer")
        for axis, count in zip("zyx", VALUES.shape, strict=True):
            inner.createDimension(axis, 2 * count)
        inner.createVariable("QN", "f4", ("z", "y", "x"))[:] = 1
    outer, finer = (read_field(path, name) for name in ("QN", "finer/QN"))
    assert outer.resolution == (4, 5, 3) and np.allclose(outer.bounds, BOUNDS)
    assert finer.resolution == (8, 10, 6) and finer.bounds is None


@pytest.mark.parametrize("order", ["z y x", "time z y x", "y z x"])
def test_heights_on_several_axes_are_taken_where_all_columns_agree(tmp_path, order):
    path, sizes = tmp_path / "f.nc", {"time": 1, "z": 3, "y": 5, "x": 4}
    shape = [sizes[name] for name in order.split()]
    along = [-1 if name == "z" else 1 for name in order.split()]
    heights = np.broadcast_to(np.reshape(CENTERS["z"], along), shape)
    slope = heights + 0.1 * np.arange(4)
    values = np.broadcast_to(VALUES if "y z" not in order else VALUES.swapaxes(0, 1), shape)
    for numbers in (slope, heights):
        axes = {axis: plain()[axis] for axis in "xy"}
        with netcdf.Dataset(written(path, values, order, **axes), "a") as file:
            file.createVariable("z", "f8", order.split())[:] = numbers
        if numbers is slope:
            assert "z differs from column to column; interpolate" in refusal(path, "QN")
    field = read_field(path, "QN")
    assert field_names(path) == ["QN"] and np.array_equal(field.values, VALUES)
    assert np.allclose(field.bounds, BOUNDS)


@pytest.mark.parametrize(
    ("name", "attributes"),
    [
        ("XTIME", {"axis": "T"}),
        ("Xtime", {}),
        ("year", {}),
        ("yt", {"units": "days since 1981-01-01"}),
        ("zenith", {}),
    ],
)
def test_other_axes_are_not_taken_for_x_y_or_z(tmp_path, name, attributes):
    """Whose single entry goes, and of whose several one is to be chosen."""
    for count in (1, 2):
        axes = plain() | {name: (np.arange(count), attributes)}
        path = written(tmp_path / "f.nc", np.stack([VALUES] * count), f"{name} z y x", **axes)
        if count == 1:
            assert np.array_equal(read_field(path, "QN").values, VALUES)
    assert f"QN has 2 entries along '{name}'; choose one" in refusal(path, "QN")


NO_LENGTH = """
x lon units=degrees_east => lon is in degrees_east, which is no known length; project
y rlat units=degrees => rlat is in degrees, which is no known length; project
x x units=rad => x is in rad, which is no known length
y y units=Mm => y is in Mm, which is no known length
z plev units=hPa positive=down => plev is in hPa, which is no known length
z z units=mbar => z is in mbar, which is no known length; interpolate to heights
z lev units=1 => lev is in 1, which is no known length; interpolate to heights
z level => level says no unit of length; interpolate to heights
z p axis=Z => p says no unit of length; interpolate to heights
z k standard_name=model_level_number => k says no unit of length; interpolate
z z => z says no unit of length, others do; say it (ncatted
y y => y says no unit of length, others do; say it (ncatted
z depth absent => depth says no unit of length; interpolate to heights
z sigma absent => sigma says no unit of length; interpolate to heights
"""
"""An axis, its name, the attributes of its coordinate unless that is absent; and a line."""


@pytest.mark.parametrize("row", NO_LENGTH.strip().splitlines())
def test_what_is_no_length_is_refused(tmp_path, row):
    """Degrees, pressures, numbers of levels, and silence beside meters."""
    coordinate, _, told = row.partition(" => ")
    axis, name, *attributes = coordinate.split()
    axes = plain(**dict.fromkeys("xyz", "m"))
    numbers, _ = axes.pop(axis)
    if attributes != ["absent"]:
        axes[name] = numbers, dict(attribute.split("=") for attribute in attributes)
    dimensions = "z y x".replace(axis, name)
    assert told in refusal(written(tmp_path / "f.nc", VALUES, dimensions, **axes), "QN")


def test_packed_values_are_unpacked(tmp_path):
    path = written(tmp_path / "f.nc", VALUES, "z y x")
    with netcdf.Dataset(path, "a") as file:
        packed = file.createVariable("QP", "i2", ("z", "y", "x"), fill_value=-1)
        packed.scale_factor, packed.add_offset = 0.25, 2.0
        packed[:] = 0.25 * np.arange(60).reshape(3, 5, 4) + 2
    assert np.array_equal(read_field(path, "QP").values.ravel(), 0.25 * np.arange(60) + 2)
    with netcdf.Dataset(path, "a") as file:
        file.variables["QP"][0, 0, 0] = np.ma.masked
    assert "QP is NaN" in refusal(path, "QP")


@pytest.mark.parametrize("order", [0, 1, -1])
def test_downward_axes_are_turned(tmp_path, order):
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


def test_a_file_without_coordinates_has_no_box(tmp_path):
    """Nor one whose coordinate is in words."""
    path = written(tmp_path / "f.nc", VALUES, "bottom_top south_north west_east")
    with netcdf.Dataset(path, "a") as file:
        words = file.createVariable("west_east", str, ("west_east",))
        words[:] = np.array(["a", "b", "c", "d"], object)
    field = read_field(path, "QN")
    assert np.array_equal(field.values, VALUES) and field.bounds is None


def test_what_does_not_fit_is_refused_with_advice(tmp_path):
    path = tmp_path / "f.nc"
    with pytest.raises(FormatError, match=r"read, not written: take \.npz"):
        write_field(path, "density", VALUES, BOUNDS)
    told = refusal(written(path, VALUES, "z y x", **plain()))
    assert told == "has no field 'density'; it has 'QN'; say name: QN beside its path"
    stretched, twice = plain() | {"z": ([6.5, 7.5, 9.0], {})}, np.stack([VALUES] * 2)
    holes = np.ma.masked_less(VALUES, VALUES.max())
    for values, dimensions, axes, told in (
        (twice, "time z y x", {}, "QN has 2 entries along 'time'; choose one"),
        (twice[:0], "time z y x", {}, "QN has 0 entries along 'time'; choose one"),
        (VALUES, "z y x", {"z": ([1, np.nan, 3], {})}, "z is not evenly spaced (nan to nan)"),
        (VALUES, "depth y x", {"depth": ([-3, -2, -1], {})}, "depth has depths below 0; say which"),
        (VALUES[:1], "a y x", {}, "has the dimensions a, y, x; name some of them x, y and z"),
        (VALUES, "z y x", stretched, "z is not evenly spaced (1 to 1.5); interpolate it first"),
        (holes, "z y x", {}, "QN is NaN"),
    ):
        assert told in refusal(written(path, values, dimensions, **axes), "QN")
