"""OpenVDB files: what OpenVDB's own tools find in ours, and how those of others become fields."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import openvdb_python
import pytest
from refusals import refusal

from ddrecon.errors import FormatError
from ddrecon.io.volumes.field import Field
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
    shape, path = (9, 40, 17), tmp_path / "smoke.vdb"
    density = sparse(*shape)
    written(path, density=density, albedo=sparse(*shape, 3), sigma_a=np.zeros(shape))
    command = ["vdb_print", "-l", path]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    _, albedo, filled, empty = text.split("Name: ")
    assert all("class: fog volume" in part for part in (albedo, filled, empty))
    assert "Tree_vec3s_5_4_3" in albedo and "Tree_float_5_4_3" in filled
    assert f"Number of active voxels:       {np.count_nonzero(density)}\n" in filled
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
    assert np.array_equal(read_field(path, "density").values, density)


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


def test_fields_of_a_file_are_read_by_name(tmp_path: Path) -> None:
    fields = {"density": sparse(3, 130, 5, 3), "full": np.ones((3, 130, 5), np.float32)}
    path = written(tmp_path / "smoke.vdb", **fields)
    assert field_names(path) == list(fields)
    for name, values in fields.items():
        assert np.array_equal(read_field(path, name).values, values)
    with pytest.raises(FormatError, match="no field 'lwc'; it has 'density', 'full'"):
        read_field(path, "lwc")


@pytest.mark.parametrize("colors", [(), (3,)])
def test_a_haze_is_not_written(tmp_path: Path, colors: tuple[int, ...]) -> None:
    """Below a ten thousandth of the largest, of either sign: a sequence stays sparse."""
    rng = np.random.default_rng(0)
    haze = (
        rng.uniform(-1, 1, (20, 20, 20, *colors))
        * 10.0 ** rng.uniform(-19, -4, (20, 20, 20))[(...,) + (None,) * len(colors)]
    )
    smoke = 4 * haze
    smoke[8:12, 8:12, 8:12] = rng.uniform(0.001, 4, (4, 4, 4, *colors))
    smoke[9, 9, 9] = 4
    path = written(tmp_path / "smoke.vdb", velocity=smoke)
    kept = np.zeros_like(smoke)
    kept[8:12, 8:12, 8:12] = smoke[8:12, 8:12, 8:12]
    assert np.array_equal(read_field(path, "velocity").values, kept.astype(np.float32))
    counts = openvdb_python.described("[g.activeVoxelCount() for g in grids.values()]", path)
    assert counts == [64]


MAKE = """
import sys, numpy as np
try: import openvdb as vdb
except ImportError: import pyopenvdb as vdb
folder, values = sys.argv[1], np.load(sys.argv[2])

def grid(name, array, steps=0.5 * np.eye(3), low=(0, 0, 0), kind=vdb.FloatGrid):
    made = kind()
    made.name = name
    made.copyFromArray(array, ijk=low)
    columns = [[*step, 0] for step in np.asarray(steps, float).tolist()]
    made.transform = vdb.createLinearTransform([*columns, [1, 2, 3, 1]])
    return made

def write(name, *grids):
    vdb.write(f"{folder}/{name}.vdb", [*grids])

c, s = np.cos(0.5), np.sin(0.5)
vel = grid("vel", np.ones((9, 9, 9, 3), "f4"), kind=vdb.Vec3SGrid)
heat = grid("temperature", values, low=(2, -1, 1))
write("fire", grid("density", values), heat, vel, grid("finer", values, np.eye(3)))
write("turned", grid("density", values, [[c, s, 0], [-s, c, 0], [0, 0, 1]]))
write("sheared", grid("density", values, [[1, 0, 0], [0.1, 1, 0], [0, 0, 1]]))
write("swapped", grid("density", values, [[0, 0, -0.5], [2, 0, 0], [0, 1, 0]]))
write("mirrored", grid("density", values, [[-0.5, 0, 0], [0, 1, 0], [0, 0, 2]]))
tapered = grid("density", values)
tapered.transform = vdb.createFrustumTransform((0, 0, 0), (9, 9, 9), 0.5, 1.0, 1.0)
write("tapered", tapered)
write("sphere", vdb.createLevelSetSphere(radius=3.0))
write("empty", grid("density", np.zeros((2, 2, 2), "f4")))
"""


@pytest.fixture(scope="module")
def strange(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of files as other programs make them, of `OTHERS` [x, y, z]."""
    folder = tmp_path_factory.mktemp("strange")
    np.save(folder / "values.npy", OTHERS)
    openvdb_python.run(MAKE, folder, folder / "values.npy")
    return folder


OTHERS = (np.random.default_rng(0).random((5, 4, 3)) + 0.1).astype(np.float32)


def converted(path: Path, name: str) -> Field:
    """The grid `name` of the file at `path`, through the program in the documentation."""
    page = (Path(__file__).parents[3] / "docs/formats.md").read_text()
    command = r"^python3 - smoke.vdb density density.npz <<'END'\n(.*?)^END$"
    (program,) = re.findall(command, page, re.MULTILINE | re.DOTALL)
    if sys.executable == openvdb_python.require():
        program = program.replace("pyopenvdb", "openvdb")
    output = path.with_name(f"{path.stem}.{name}.npz")
    openvdb_python.run(program, path, name, output)
    return read_field(output, name)


def test_grids_of_another_program_share_one_box(strange: Path) -> None:
    """That of all with the same voxels, so that a scene may have several of them."""
    assert "docs/formats.md has the lines" in refusal(strange / "fire.vdb")
    density, temperature = (converted(strange / "fire.vdb", n) for n in ("density", "temperature"))
    for field, low in ((density, (0, 0, 0)), (temperature, (2, -1, 1))):
        expected = np.zeros((7, 5, 4), np.float32)
        x, y, z = np.add(low, (0, 1, 0))
        expected[x : x + 5, y : y + 4, z : z + 3] = OTHERS
        assert np.array_equal(field.values, expected.T)
        assert np.allclose(field.bounds, [[0.75, 1.25, 2.75], [4.25, 3.75, 4.75]])


@pytest.mark.parametrize(
    ("file", "steps"),
    [("swapped", [[0, 0, -0.5], [2, 0, 0], [0, 1, 0]]), ("mirrored", np.diag([-0.5, 1, 2]))],
)
def test_exchanged_and_mirrored_axes_are_put_in_order(
    strange: Path, file: str, steps: np.ndarray
) -> None:
    """Each voxel keeps its place in the world."""
    field = converted(strange / f"{file}.vdb", "density")
    assert field.bounds is not None and field.values.size == OTHERS.size
    for index, value in np.ndenumerate(OTHERS):
        world = np.array(index) @ steps + [1, 2, 3]
        part = (world - field.bounds[0]) / (field.bounds[1] - field.bounds[0])
        x, y, z = (part * field.resolution).astype(int)
        assert field.values[z, y, x] == value


@pytest.mark.parametrize(
    ("file", "name", "reason"),
    [
        *((file, "density", "are turned") for file in ("turned", "sheared", "tapered")),
        ("fire", "vel", r"vel is not one grid of type float; the file has .*, vel \(vec3s\)"),
        ("fire", "heat", r"heat is not one grid of type float; the file has density \(float\), "),
        ("sphere", "", "is a level set"),
        ("empty", "density", "no voxel of density is active"),
    ],
)
def test_grids_that_are_no_upright_fog_are_refused(
    strange: Path, file: str, name: str, reason: str
) -> None:
    path = strange / f"{file}.vdb"
    with pytest.raises(AssertionError, match=f"^{path}: .*{reason}.*\n$"):
        converted(path, name)
