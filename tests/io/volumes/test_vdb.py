"""OpenVDB files: what OpenVDB's own tools find in ours, and what we find in theirs."""

import shutil
import subprocess

import numpy as np
import openvdb_python
import pytest
from refusals import refusal

from ddrecon.errors import DataWarning
from ddrecon.io.volumes.table import field_names, read_field, write_fields

BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 2.5, 3.0]])


def sparse(*shape, seed=0):
    """Values of which most are 0, whole leaves among them."""
    rng = np.random.default_rng(seed)
    return np.where(rng.random(shape) > 0.999, rng.random(shape), 0).astype(np.float32)


def written(path, facts=None, **fields):
    write_fields(path, fields, BOUNDS, facts)
    return path


def test_the_tools_of_openvdb_list_the_grids(tmp_path):
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


def test_openvdb_knows_facts_and_what_vectors_are(tmp_path):
    """Numbers, colors and texts are metadata of each grid; arrows turn with a grid, colors not."""
    facts = {"sigma_t": np.array([1.5, 2, 4]), "g": np.array(0.1), "units": "sigma_t [1/u] µ"}
    vectors = dict.fromkeys(("velocity", "albedo"), sparse(9, 4, 5, 3))
    path = written(tmp_path / "smoke.vdb", facts, density=sparse(9, 4, 5), **vectors)
    told = "[[g['sigma_t'], g['g'], g['units']] for g in grids.values()]"
    values = [1.5, 2, 4], 0.1, facts["units"]
    assert openvdb_python.described(told, path) == 3 * [[*values]]
    kinds = "{n: [g.gridClass, g.metadata.get('vector_type')] for n, g in grids.items()}"
    assert openvdb_python.described(kinds, path) == {
        "density": ["fog volume", None],
        "albedo": ["fog volume", None],
        "velocity": ["unknown", "contravariant relative"],
    }


def test_facts_come_back_as_labels(tmp_path):
    """Those of OpenVDB's library too, of every type; what tells of the file alone is left out."""
    facts = {"sigma_t": np.array([1.5, 2, 4]), "g": np.array(0.1), "units": "sigma_t [1/u] µ"}
    path = written(tmp_path / "smoke.vdb", facts, density=sparse(9, 4, 5))
    labels = {"sigma_t": [1.5, 2, 4], "g": [0.1], "units": facts["units"], "class": "fog volume"}
    assert read_field(path, "density").labels == labels
    openvdb_python.run(LABEL, tmp_path)
    read = read_field(tmp_path / "theirs.vdb", "density").labels
    assert read["a"] == [True] and read["b"] == [-3] and read["c"] == [0.5] and read["d"] == "é"
    assert not {"name", "file_voxel_count"} & {*read}


LABEL = """
import sys
try: import openvdb as vdb
except ImportError: import pyopenvdb as vdb
grid = vdb.FloatGrid()
grid.name = "density"
grid.fill((0, 0, 0), (3, 3, 3), 1.0)
for name, value in {"a": True, "b": -3, "c": 0.5, "d": "é"}.items():
    grid[name] = value
vdb.write(f"{sys.argv[1]}/theirs.vdb", [grid])
"""


def test_only_leaves_that_hold_something_are_there(tmp_path):
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
def test_cells_lie_where_openvdb_has_them(tmp_path, shape, kind):
    """Index (0, 0, 0) is the center of the first cell."""
    path = written(tmp_path / "smoke.vdb", density=np.ones(shape))
    facts = (
        "[[g.transform.typeName, g.transform.indexToWorld((0, 0, 0)), g.transform.voxelSize()] "
        "for g in grids.values()]"
    )
    ((name, first, size),) = openvdb_python.described(facts, path)
    sides = (BOUNDS[1] - BOUNDS[0]) / shape[::-1]
    assert name == kind and np.allclose(size, sides) and np.allclose(first, BOUNDS[0] + sides / 2)


@pytest.mark.parametrize("colors", [(), (3,)])
def test_a_haze_is_not_written(tmp_path, colors):
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
folder, rng = sys.argv[1], np.random.default_rng(0)
c, s = np.cos(0.5), np.sin(0.5)
TURNED = [[c, s, 0, 0], [-s, c, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]
UPRIGHT = [[0, 0, 2, 0], [0.5, 0, 0, 0], [0, -1, 0, 0], [1, 2, 3, 1]]

def make(name, kind, places, transform=UPRIGHT, half=False):
    grid = kind()
    grid.name, grid.transform = name, vdb.createLinearTransform(transform)
    shape = (30, 20, 25, 3) if kind is vdb.Vec3SGrid else (30, 20, 25)
    smooth = np.exp(-np.linalg.norm(np.indices(shape)[:3], axis=0))
    grid.copyFromArray((smooth + rng.random(shape) * places).astype("f4"), ijk=(-3, 4, -9))
    if kind is vdb.FloatGrid:
        grid.fill((8, 8, 8), (23, 15, 15), 0.5)
        grid.prune()
    if half:
        grid.saveFloatAsHalf = True
        vdb.write(f"{folder}/half.vdb", [grid])
        grid, = vdb.readAll(f"{folder}/half.vdb")[0]
        grid.saveFloatAsHalf = True
    return grid

noise, blocks = 1, np.indices((30, 20, 25)).sum(0) % 2
grids = [
    make("noise", vdb.FloatGrid, noise), make("even", vdb.FloatGrid, 0),
    make("half", vdb.FloatGrid, blocks, half=True), make("color", vdb.Vec3SGrid, noise),
    make("turned", vdb.FloatGrid, noise, TURNED), vdb.createLevelSetSphere(radius=3.0),
]
again = grids[0].copy()  # shares its tree
again.name = "again"
vdb.write(f"{folder}/theirs.vdb", [*grids, again])
for grid in [*grids[:4], again]:
    low, high = grid.evalActiveVoxelBoundingBox()
    values = np.zeros([b - a + 1 for a, b in zip(low, high)] + [3] * (grid.name == "color"), "f4")
    grid.copyToArray(values, ijk=low)
    centers = [grid.transform.indexToWorld(place) for place in (low, high)]
    np.savez(f"{folder}/{grid.name}.npz", values=values, centers=centers)
"""


def test_files_of_openvdb_are_read(tmp_path):
    """As itself reads them: packed by Blosc, with tiles, halves and a shared tree."""
    openvdb_python.run(MAKE, tmp_path)
    path = tmp_path / "theirs.vdb"
    names = ["noise", "even", "half", "color", "again"]
    assert set(field_names(path)) == {*names, "turned", "[0]"}
    for name in names:
        theirs, field = np.load(tmp_path / f"{name}.npz"), read_field(path, name)
        # UPRIGHT: x runs along j, y backward along k, and z along i.
        values = theirs["values"].swapaxes(1, 2)[:, ::-1]
        assert np.array_equal(field.values, values) and field.bounds is not None
        half = (field.bounds[1] - field.bounds[0]) / field.resolution / 2
        low, high = np.sort(theirs["centers"], axis=0)
        assert np.allclose(field.bounds, [low - half, high + half])
    with pytest.warns(DataWarning, match="turned is turned; resampled"):
        assert read_field(path, "turned").values.max() > 0.5
    assert refusal(path, "[0]").startswith("[0] is a level set")
