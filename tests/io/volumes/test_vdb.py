"""OpenVDB files: what OpenVDB's own tools find in ours, how its grids become fields, and what is
said where it is not at hand.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import openvdb_python
import pytest

from ddrecon.errors import FormatError
from ddrecon.io.volumes.table import field_names, read_field, write_fields

BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 2.5, 3.0]])


def sparse(*shape: int, seed: int = 0) -> np.ndarray:
    """Values of which most are 0, whole leaves among them."""
    rng = np.random.default_rng(seed)
    return np.where(rng.random(shape) > 0.999, rng.random(shape), 0).astype(np.float32)


def written(path: Path, **fields: np.ndarray) -> Path:
    write_fields(path, fields, BOUNDS)
    return path


def test_the_tools_of_openvdb_list_the_grids(tmp_path: Path) -> None:
    if shutil.which("vdb_print") is None:
        pytest.skip("no vdb_print: apt-get install libopenvdb-tools")
    density = sparse(9, 40, 17)
    path = written(
        tmp_path / "smoke.vdb",
        density=density,
        albedo=sparse(9, 40, 17, 3),
        sigma_a=np.zeros((9, 40, 17)),
    )
    text = subprocess.run(
        ["vdb_print", "-l", path], check=True, capture_output=True, text=True
    ).stdout
    _, albedo, filled, empty = text.split("Name: ")
    assert "Tree_vec3s_5_4_3" in albedo and all(
        "class: fog volume" in part for part in (albedo, filled, empty)
    )
    assert (
        filled.startswith("density\n")
        and "Tree_float_5_4_3" in filled
        and f"Number of active voxels:       {np.count_nonzero(density)}\n" in filled
    )
    assert empty.startswith("sigma_a\n") and "Background value: 0\n" in empty


def test_only_leaves_that_hold_something_are_there(tmp_path: Path) -> None:
    """Also in a box so long that the root of the tree has two children."""
    density = sparse(9, 12, 4200)
    leaves = {(z // 8, y // 8, x // 8) for z, y, x in np.argwhere(density)}
    path = written(tmp_path / "long.vdb", density=density)
    grid = "[[g.leafCount(), g.activeVoxelCount(), g.nonLeafCount()] for g in grids.values()]"
    assert openvdb_python.described(grid, path) == [
        [len(leaves), np.count_nonzero(density), 1 + 2 + len({leaf[2] // 16 for leaf in leaves})]
    ]
    assert np.array_equal(openvdb_python.read_all(path)["density"].values, density)


@pytest.mark.parametrize(
    ("shape", "kind"), [((4, 3, 2), "ScaleTranslateMap"), ((12, 9, 4), "UniformScaleTranslateMap")]
)
def test_cells_lie_where_openvdb_has_them(
    tmp_path: Path, shape: tuple[int, int, int], kind: str
) -> None:
    """Index (0, 0, 0) is the center of the first cell."""
    path = written(tmp_path / "smoke.vdb", density=np.ones(shape))
    facts = (
        "[[g.transform.typeName, g.transform.indexToWorld((0, 0, 0)), g.transform.voxelSize()] "
        "for g in grids.values()]"
    )
    ((name, first, size),) = openvdb_python.described(facts, path)
    sides = (BOUNDS[1] - BOUNDS[0]) / shape[::-1]
    assert name == kind and np.allclose(size, sides) and np.allclose(first, BOUNDS[0] + sides / 2)


MAKE = """
import sys, numpy as np
try: import openvdb as vdb
except ImportError: import pyopenvdb as vdb
density, heat = vdb.FloatGrid(), vdb.FloatGrid()
for grid, place in (density, (2, -3, 5)), (heat, (4, -3, 6)):
    grid.transform = vdb.createLinearTransform(0.5)
    grid.fill(place, place, 2.0)
density.name, heat.name = "density", "heat"
turned = density.deepCopy()
turned.name = "turned"
turned.transform.rotate(0.3)
vdb.write(sys.argv[1], [density, heat, turned])
"""


def test_grids_of_other_programs_share_the_box_of_what_is_active(tmp_path: Path) -> None:
    path = tmp_path / "other.vdb"
    openvdb_python.run(MAKE.replace(", turned]", "]"), path)
    fields = openvdb_python.read_all(path)
    expected = np.zeros((2, 1, 3))
    expected[0, 0, 0] = 2
    assert np.array_equal(fields["density"].values, expected) and np.array_equal(
        fields["heat"].values, expected[::-1, :, ::-1]
    )
    for field in fields.values():
        assert np.allclose(field.bounds, [[0.75, -1.75, 2.25], [2.25, -1.25, 3.25]])


CATCH = """
import sys; from pathlib import Path; from ddrecon.errors import FormatError
from ddrecon.io.volumes.table import read_field
for path, name in zip(sys.argv[1::2], sys.argv[2::2]):
    try: read_field(Path(path), name)
    except FormatError as error: print(error.reason)
"""


def test_what_cannot_be_read_is_refused_by_name(tmp_path: Path) -> None:
    path, none, half = (tmp_path / f"{name}.vdb" for name in ("other", "none", "half"))
    openvdb_python.run(MAKE, path)
    half.write_bytes(path.read_bytes()[:300])
    asked = (path, "turned"), (path, "lwc"), (none, "density"), (half, "density")
    told = openvdb_python.run(CATCH, *(word for words in asked for word in words)).splitlines()
    turned, unknown, missing, damaged = told
    assert "'turned' is turned" in turned and "No such file" in missing
    assert unknown == "has no grid 'lwc'; it has 'density', 'heat', 'turned'"
    assert "not an OpenVDB file that can be read" in damaged


@pytest.fixture
def without_openvdb(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenVDB's module is not installed."""
    for name in ("openvdb", "pyopenvdb"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.parametrize("shape", [(1, 1, 1), (9, 40, 17), (9, 12, 4200), (3, 130, 5, 3)])
@pytest.mark.usefixtures("without_openvdb")
def test_what_we_write_is_read_without_openvdb(tmp_path: Path, shape: tuple[int, ...]) -> None:
    """Also in a box so long that the root of the tree has two children."""
    fields = {"density": sparse(*shape), "full": np.random.default_rng(1).random(shape, np.float32)}
    path = tmp_path / "smoke.vdb"
    write_fields(path, fields, BOUNDS, {"g": np.array(0.3), "albedo": np.ones(3)})
    assert field_names(path) == list(fields)
    for name, values in fields.items():
        found = read_field(path, name)
        assert np.array_equal(found.values, values)
        assert np.allclose(found.bounds, BOUNDS, rtol=1e-14, atol=0)
    with pytest.raises(FormatError, match="no grid 'lwc'; it has 'density', 'full'"):
        read_field(path, "lwc")


@pytest.mark.parametrize("place", [8, 12], ids=["file version", "library version"])
@pytest.mark.usefixtures("without_openvdb")
def test_without_openvdb_the_ways_are_named(tmp_path: Path, place: int) -> None:
    path = written(tmp_path / "smoke.vdb", density=np.ones((1, 2, 3)))
    data = bytearray(path.read_bytes())
    data[place] += 1
    path.write_bytes(data)
    module, package = "needs the Python module openvdb", "apt-get install python3-openvdb"
    with pytest.raises(FormatError, match=rf"{module}.*Blender.*{package}.*docs/formats\.md"):
        read_field(path, "density")


def test_openvdb_finds_the_constants(tmp_path: Path) -> None:
    path, colors = tmp_path / "smoke.vdb", np.array([0.5, 0.25, 1])
    write_fields(
        path, {"density": np.ones((1, 2, 3))}, BOUNDS, {"g": np.array(0.5), "albedo": colors}
    )
    found = openvdb_python.described("vdb.readAll(sys.argv[1])[1]", path)
    assert found == {"g": 0.5, "albedo": colors.tolist()}


def test_the_line_in_the_documentation_converts(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs/formats.md").read_text()
    (program,) = re.findall(r"^python3 -c '(.*)' smoke.vdb density smoke.npz$", page, re.MULTILINE)
    if sys.executable == openvdb_python.require():
        program = program.replace("pyopenvdb", "openvdb")
    density = np.pad(
        np.random.default_rng(0).random((3, 4, 5)) + 0.1, ((0, 0), (1, 0), (0, 2))
    ).astype(np.float32)
    written(tmp_path / "smoke.vdb", density=density)
    openvdb_python.run(program, tmp_path / "smoke.vdb", "density", tmp_path / "smoke.npz")
    field = read_field(tmp_path / "smoke.npz", "density")
    side = (BOUNDS[1] - BOUNDS[0]) / (7, 5, 3)
    assert np.array_equal(field.values, density[:, 1:, :5])
    assert np.allclose(field.bounds, BOUNDS + np.array([[0, side[1], 0], [-2 * side[0], 0, 0]]))
