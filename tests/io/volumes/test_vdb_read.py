"""Reading .vdb: files of every kind, encoded here without the reader's code, and damaged ones."""

import struct
import tracemalloc

import numpy as np
import pytest
import vdb_files
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refusal
from vdb_files import Encoder, Grid, Tile, write_file

from ddrecon.errors import DataWarning
from ddrecon.io.volumes.table import read_field

NONE, ZIP, MASK, BLOSC = 0, 1, 2, 4
QUICK = settings(derandomize=True, database=None, deadline=None, max_examples=10)
HALF = 0.5


def leaf(rng, grid):
    """Values and activity of a leaf, inactive values of none to many kinds among them."""
    is_active = rng.random(512) < rng.choice([0, 0.02, 0.5, 1])
    choices = [[0], [grid.background], [-grid.background], [-1, 1], [0.25, 7], [1, 2, 3]]
    inactive = rng.choice(choices[rng.integers(len(choices))], 512)
    # Smooth ones repeat, and noise does not.
    active = rng.choice([np.round(rng.random(512), 1), rng.random(512)])
    values = np.where(is_active, active, inactive)[:, None] * np.ones(grid.components)
    return (values * np.linspace(1, 2, grid.components)).astype(np.float16), is_active


def filled(grid, seed, size=3):
    """`grid` with leaves and tiles on both sides of 0, and a leaf in another root's child."""
    rng = np.random.default_rng(seed)
    for _ in range(size):
        x, y, z = (8 * rng.integers(-4, 4, 3)).tolist()
        grid.leaves[x, y, z] = leaf(rng, grid)
    grid.leaves[-8, 0, 0] = leaf(rng, grid)[0], np.arange(512) % 5 == 0
    for side, corner in ((8, (32, -8, 0)), (8, (32, -8, 8)), (128, (0, 128, 0))):
        value = np.linspace(HALF, 1, grid.components)
        grid.tiles.append(Tile(corner, side, value, bool(rng.random() < 0.3) and side == 8))
    return grid


@pytest.mark.parametrize("flags", [NONE, ZIP, MASK, ZIP | MASK, BLOSC, BLOSC | MASK])
@QUICK
@given(
    kind=st.sampled_from([*vdb_files.TYPES]),
    is_half=st.booleans(),
    version=st.sampled_from([220, 221, 222, 223, 224, 225]),
    background=st.sampled_from([0.0, 0.125]),
    seed=st.integers(0, 2**32),
)
def test_values_come_back_bit_for_bit(
    tmp_path_factory, flags, kind, is_half, version, background, seed
):
    """Of every type and version, however they are compressed: inactive ones and tiles, too."""
    if version < 222:
        flags &= ZIP
    grid = Grid(kind=kind, is_half=is_half and kind != "half", flags=flags, background=background)
    path = write_file(tmp_path_factory.mktemp("vdb") / "a.vdb", filled(grid, seed), version=version)
    low, high = grid.box()
    field = read_field(path, "density")
    values = field.values.reshape(*field.values.shape[:3], -1).transpose(2, 1, 0, 3)
    assert np.array_equal(values, grid.dense(low, high))
    assert np.allclose(field.bounds, [HALF * (low - 0.5), HALF * (high - 0.5)])


def test_what_is_large_is_a_tile(tmp_path):
    """Of a root, inactive and beyond the box; and of an upper node, active."""
    grid = Grid(leaves={(4088, 0, 0): (np.ones((512, 1)), np.ones(512, bool))})
    grid.tiles = [
        Tile((4096, 0, 0), 4096, np.array([7.0]), False),
        Tile((3840, 0, 0), 128, np.array([0.5]), True),
        Tile((4096, 4096, 0), 4096, np.array([9.0]), False),
    ]
    grid.leaves[8192, 0, 0] = grid.leaves[4088, 0, 0]
    values = read_field(write_file(tmp_path / "a.vdb", grid), "density").values
    assert values.shape == (128, 128, 4360)
    expected = np.zeros(4360)
    expected[:128], expected[256:4352] = 0.5, 7
    assert np.array_equal(values[64, 64], expected)
    expected[248:256] = expected[4352:] = 1
    assert np.array_equal(values[0, 0], expected)


def test_a_shared_tree_has_its_own_transform(tmp_path):
    """And grids of the same name have numbers."""
    first = filled(Grid(name="density\x1e0", flags=BLOSC | MASK), 1)
    second = Grid(name="density\x1e1", parent="density\x1e0", map=("UniformScaleMap", [2.0] * 15))
    path = write_file(tmp_path / "a.vdb", first, second)
    fields = [read_field(path, f"density[{number}]") for number in (0, 1)]
    assert np.array_equal(fields[0].values, fields[1].values)
    assert np.array_equal(4 * fields[0].bounds, fields[1].bounds)
    second.parent = "heat"
    told = refusal(write_file(path, first, second), "density[1]")
    assert told == "density[1] shares the tree of heat, which is not there"
    second.parent, first.parent = first.name, second.name
    told = refusal(write_file(path, first, second), "density[0]")
    assert told == "density[0] shares the tree of density[1], which is not there"


def moved(*steps, by=(0, 0, 0)):
    return "ScaleTranslateMap", [*by, *steps, *[0] * 12]


def test_grids_with_the_same_voxels_share_a_box(tmp_path):
    """Also where their voxels are counted from elsewhere; a velocity widens no other grid's box."""
    leaf_of = {(0, 0, 0): (np.ones((512, 1)), np.ones(512, bool))}
    density = Grid(leaves=leaf_of, map=moved(0.1, 0.2, 0.3))
    heat = Grid("heat", leaves=leaf_of, map=moved(0.1, 0.2, 0.3, by=(1.6 + 1e-9, 0, -0.3)))
    finer = Grid("finer", leaves=leaf_of, map=moved(0.05, 0.2, 0.3))
    aside = Grid("aside", leaves=leaf_of, map=moved(0.1, 0.2, 0.3, by=(0.05, 0, 0)))
    empty = Grid("empty", map=moved(0.1, 0.2, 0.3))
    vel = Grid("Vel", leaves={(-80, 0, 0): leaf_of[0, 0, 0]}, map=moved(0.1, 0.2, 0.3))
    path = write_file(tmp_path / "a.vdb", density, heat, finer, aside, empty, vel)
    fields = {name: read_field(path, name) for name in ("density", "heat", "empty")}
    for field in fields.values():
        assert field.resolution == (24, 8, 9)
        assert np.array_equal(field.bounds, fields["density"].bounds)
    assert np.allclose(fields["heat"].bounds, [[-0.05, -0.1, -0.45], [2.35, 1.5, 2.25]])
    assert fields["density"].values[1:, :, :8].min() == 1
    assert fields["heat"].values[:8, :, 16:].min() == 1
    assert all(fields[name].values.sum() == 512 for name in ("density", "heat"))
    assert not fields["empty"].values.any()
    assert {read_field(path, name).resolution for name in ("finer", "aside")} == {(8, 8, 8)}
    assert read_field(path, "Vel").resolution == (104, 8, 9)


def affine(steps):
    rows = np.eye(4)
    rows[:3, :3], rows[3, :3] = steps, (1, 2, 3)
    return "AffineMap", rows.ravel()


@pytest.mark.parametrize(
    "steps",
    [
        np.diag([0.5, 2, -1]),
        [[0, 0, -0.5], [2, 0, 0], [0, 1, 0]],
        [[0, -1, 0], [0, 0, 1], [3, 0, 0]],
    ],
)
def test_exchanged_and_mirrored_axes_are_put_in_order(tmp_path, steps):
    """Each voxel keeps its place in the world."""
    grid = filled(Grid(map=affine(steps), flags=MASK), 3)
    field = read_field(write_file(tmp_path / "a.vdb", grid), "density")
    low, high = grid.box()
    values = grid.dense(low, high)[..., 0]
    assert field.bounds is not None and field.values.size == values.size
    for index in np.random.default_rng(0).integers(0, values.shape, (200, 3)):
        world = (low + index) @ np.array(steps) + [1, 2, 3]
        part = (world - field.bounds[0]) / (field.bounds[1] - field.bounds[0])
        x, y, z = np.floor(part * field.resolution).astype(int)
        assert field.values[z, y, x] == values[tuple(index)]


def test_a_turned_grid_is_resampled(tmp_path):
    """A linear function stays one within, nothing is beyond, and the mass is the same."""
    cosine, sine = np.cos(0.5), np.sin(0.5)
    steps = 0.1 * np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    index = np.indices((8, 8, 8)).reshape(3, -1)
    value = 1 + index.T @ [0.1, 0.2, 0.4]
    grid = Grid(map=affine(steps), leaves={(0, 0, 0): (value[:, None], np.ones(512, bool))})
    path = write_file(tmp_path / "a.vdb", grid)
    with pytest.warns(
        DataWarning, match="density is turned; resampled to 11 x 11 x 8 cubes of 0.1"
    ):
        field = read_field(path, "density")
    assert field.bounds is not None
    sides = (field.bounds[1] - field.bounds[0]) / field.resolution
    assert np.allclose(sides, 0.1) and field.resolution == (11, 11, 8)
    corners = np.array([[x, y, z] for x in (-0.5, 7.5) for y in (-0.5, 7.5) for z in (-0.5, 7.5)])
    corners = corners @ steps + [1, 2, 3]
    assert (field.bounds[0] < corners.min(0) + 1e-9).all()
    assert (field.bounds[1] > corners.max(0) - 1e-9).all()
    z, y, x = (np.indices(field.values.shape).reshape(3, -1) + 0.5) * 0.1
    places = np.stack([x, y, z], 1) + field.bounds[0]
    at = (places - [1, 2, 3]) @ np.linalg.inv(steps)
    is_inside = ((at > 0) & (at < 7)).all(1)
    is_beyond = ((at < -1) | (at > 8)).any(1)
    values = field.values.ravel()
    assert is_inside.sum() > 200 and is_beyond.sum() > 50
    assert np.allclose(values[is_inside], 1 + at[is_inside] @ [0.1, 0.2, 0.4], rtol=1e-5)
    assert not values[is_beyond].any()
    assert abs(values.sum() / value.sum() - 1) < 0.02


def test_bounds_of_another_program_need_no_scale(tmp_path):
    """Every type of transform, as OpenVDB's own arithmetic has it."""
    maps = {
        "ScaleMap": [1, 2, 3, *[0] * 12],
        "TranslationMap": [5, 6, 7],
        "UniformScaleTranslateMap": [5, 6, 7, 2, 2, 2, *[0] * 12],
        "UnitaryMap": np.eye(4).ravel(),
    }
    firsts = {"ScaleMap": [0, 0, 0], "UnitaryMap": [0, 0, 0]}
    sides = {"ScaleMap": [1, 2, 3], "UniformScaleTranslateMap": [2, 2, 2]}
    for kind, numbers in maps.items():
        grid = Grid(map=(kind, numbers), leaves={(0, 0, 0): (np.ones((512, 1)), np.ones(512) > 0)})
        field = read_field(write_file(tmp_path / "a.vdb", grid), "density")
        first, side = np.array(firsts.get(kind, [5, 6, 7])), np.array(sides.get(kind, [1, 1, 1]))
        assert np.allclose(field.bounds, [first - side / 2, first + 7.5 * side])


FULL = {(0, 0, 0): (np.ones((512, 1)), np.ones(512, bool))}


@pytest.mark.parametrize(
    ("grid", "reason"),
    [
        (Grid(labels={"class": "level set"}, leaves=FULL), "density is a level set (distances)"),
        (Grid(labels={"class": "staggered"}, leaves=FULL), "density is staggered"),
        (Grid(tree="Tree_float_4_3_3"), "density is of type Tree_float_4_3_3; Tree_..._5_4_3 of"),
        (Grid(tree="Tree_ptdataidx32_5_4_3"), "density is of type Tree_ptdataidx32_5_4_3"),
        (Grid(map=("NonlinearFrustumMap", [])), "density has a transform of type NonlinearFrustum"),
        (Grid(map=moved(1, 1, 0)), "density has a transform without three axes"),
        (Grid(map=moved(1, 1, np.nan)), "density has a transform of type ScaleTranslateMap"),
        (Grid(), "density has no active voxel"),
        (Grid(leaves=FULL | {(10**6, 10**6, 10**6): FULL[0, 0, 0]}), "density, of 1000008 x 10000"),
        (Grid(tiles=[Tile((0, 0, 0), 4096, np.ones(1), True)]), "density, of 4096 x 4096 x 4096 "),
    ],
)
def test_what_is_no_fog_is_refused_by_name(tmp_path, grid, reason):
    assert refusal(write_file(tmp_path / "a.vdb", grid)).startswith(reason)


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "a.vdb"
    for version in (219, 226):
        told = refusal(write_file(path, Grid(leaves=FULL), version=version))
        assert told == f"is of the file version {version}; 220 to 225 are read"
    write_file(path, Grid(leaves=FULL), has_places=0)
    assert refusal(path) == "was written as a stream: save it as a file, by OpenVDB's File"
    whole = write_file(path, Grid(leaves=FULL)).read_bytes()
    begin = struct.pack("<q", at := whole.index(b"Tree") + len("Tree_float_5_4_3") + 4 + 24)
    for wrong in (0, at - 1, 2**62):
        path.write_bytes(whole.replace(begin, struct.pack("<q", wrong)))
        assert refusal(path).startswith(f"is damaged: density begins at {wrong} and ends at ")
    ones = np.ones(512, "<f4").tobytes()
    path.write_bytes(whole.replace(b"\0" + ones, b"\7" + ones))
    assert refusal(path) == "is damaged: a node has the code 7"
    path.write_bytes(b"VDB" * 100)
    assert refusal(path) == "is no OpenVDB file"


@pytest.mark.parametrize("flags", [ZIP, BLOSC])
def test_a_bomb_is_not_unpacked(tmp_path, flags):
    """A node's values are unpacked as far as it has some."""
    whole = write_file(tmp_path / "a.vdb", Grid(leaves=FULL, flags=flags)).read_bytes()
    pack = Encoder(Grid(flags=flags), 224).many
    values, bomb = pack(np.zeros((32**3, 1))), pack(np.zeros((10**7, 1)))
    assert whole.count(values) == 1
    (tmp_path / "a.vdb").write_bytes(whole.replace(values, bomb))
    tracemalloc.start()
    try:
        assert refusal(tmp_path / "a.vdb").startswith("is damaged: values of 131072 bytes have ")
        assert tracemalloc.get_traced_memory()[1] < 3 * 10**6
    finally:
        tracemalloc.stop()
