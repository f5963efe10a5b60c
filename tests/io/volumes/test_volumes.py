"""Archives of numpy and .vol, and what every volume must be."""

import struct
from typing import Any

import numpy as np
import pytest
from refusals import refusal

from ddrecon.errors import FormatError
from ddrecon.io.info import describe
from ddrecon.io.volumes.table import read_field, write_field

BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 2.5, 3.0]])
CUBE = np.ones((2, 2, 2))


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.uint8, bool])
def test_every_real_type_is_read_as_float32(tmp_path, dtype):
    np.savez(tmp_path / "f.npz", density=np.ones((2, 3, 4), dtype))
    field = read_field(tmp_path / "f.npz", "density")
    assert field.values.dtype == np.float32 and field.values.min() == 1 and field.bounds is None


@pytest.mark.parametrize("before", [(), (1,), (1, 1)])
@pytest.mark.parametrize("behind", [(), (1,), (1, 1), (3,), (3, 1)])
def test_axes_of_one_entry_beside_those_of_cells_go(tmp_path, before, behind):
    """As of ScalarFlow's [z, y, x, 1], or of a batch of one."""
    values = np.random.default_rng(0).random((2, 3, 4, *behind), np.float32)
    np.savez(tmp_path / "f.npz", data=values.reshape(*before, *values.shape))
    found = read_field(tmp_path / "f.npz", "data").values
    assert np.array_equal(found, values.reshape((2, 3, 4, 3) if 3 in behind else (2, 3, 4)))


def flawed(value):
    values = np.zeros((2, 3, 4))
    values[1, 2, 3] = value
    return values


PLACE = "at cell (x, y, z) = (3, 2, 1) (1 such values)"
SHAPES = (), (4,), (2, 2), (2, 2, 2, 2), (2, 2, 2, 3, 2), (0, 2, 2)
BOXES = BOUNDS[::-1], BOUNDS[:1], np.full((2, 3), np.nan), BOUNDS.T
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"lwc": CUBE, "reff": CUBE, "bounds": BOUNDS}, "has no field 'density'; it has 'lwc', 'reff'"),
    ({"arr_0": CUBE}, "has no field 'density'; it has 'arr_0'; say name: arr_0 beside its path"),
    *(({"density": np.ones(shape)}, "expected [z, y, x]") for shape in SHAPES),
    ({"density": np.ones((1, 1, 1), complex)}, "complex"),
    ({"density": np.array([[["a"]]])}, "values of type"),
    ({"density": flawed(np.nan)}, f"density is NaN or infinite {PLACE}"),
    ({"density": flawed(1e300)}, f"density is NaN or infinite {PLACE}"),
    *(({"density": CUBE, "bounds": bounds}, "bounds must be [[xmin") for bounds in BOXES),
]


@pytest.mark.parametrize(("arrays", "told"), REFUSED)
def test_what_is_no_field_is_refused_with_advice(tmp_path, arrays, told):
    np.savez(tmp_path / "f.npz", **arrays)
    assert told in refusal(tmp_path / "f.npz")


def test_nanovdb_is_refused_with_what_converts_it(tmp_path):
    path = tmp_path / "smoke.nvdb"
    with pytest.raises(FormatError, match=r"try nanovdb_convert smoke\.nvdb"):
        describe(path)


VALUES = np.arange(24, dtype=np.float32).reshape(2, 3, 4)


@pytest.mark.parametrize("has_colors", [False, True])
def test_mitsuba_reads_and_writes_the_same_files(tmp_path, has_colors):
    mitsuba = pytest.importorskip("mitsuba", reason="needs Mitsuba 3 (the extra `reference`)")
    values = np.stack([VALUES, 2 * VALUES, 3 * VALUES], -1) if has_colors else VALUES
    mitsuba.set_variant("scalar_rgb")
    ours, theirs = tmp_path / "ours.vol", tmp_path / "theirs.vol"
    write_field(ours, "density", values, BOUNDS)
    grid = mitsuba.VolumeGrid(str(ours))
    assert np.array_equal(np.array(grid).reshape(values.shape), values)
    grid.write(str(theirs))
    assert np.array_equal(read_field(theirs, "density").values, values)


DAMAGES = [(0, "3s", b"VOX", "not a Mitsuba volume"), (3, "B", 2, "version 2")]
DAMAGES += [(4, "<i", 3, "type 3"), (8, "<i", 5, "5 x 3 x 2 cells")]
DAMAGES += [(8, "<i", -4, "is damaged"), (20, "<i", 2, "is damaged")]


@pytest.mark.parametrize(("offset", "layout", "value", "reason"), DAMAGES)
def test_a_damaged_vol_is_refused(tmp_path, offset, layout, value, reason):
    path = tmp_path / "f.vol"
    write_field(path, "density", VALUES, BOUNDS)
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, offset, value)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=reason):
        read_field(path, "density")
