"""What `ddrecon export` writes, and what `ddrecon info` says of volumes and images."""

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import openvdb_python
import pytest
from small_scene import contents

from ddrecon.io.volumes.table import field_names, read_field, write_field


def test_a_scene_becomes_xml_and_a_volume(succeed):
    before = set(contents(Path()))
    result = succeed("export", "scene.yaml", "-o", "smoke.xml")
    assert set(contents(Path())) - before == {"smoke.xml", "smoke.sigma_t.vol"}
    assert result.stdout == "written: smoke.xml, smoke.sigma_t.vol\n"
    root = ElementTree.parse("smoke.xml").getroot()
    assert [sensor.attrib["name"] for sensor in root.iter("sensor")] == ["sensor_0", "sensor_1"]
    kinds = {emitter.attrib["type"] for emitter in root.iter("emitter")}
    assert kinds == {"directional", "constant"}


def test_a_scenes_cameras_become_transforms(succeed):
    said = succeed("export", "scene.yaml", "-o", "transforms.json").stdout
    assert said == "written: transforms.json\n"
    frames = json.loads(Path("transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["front.npy", "side.npy"]
    before = json.loads(succeed("check", "scene.yaml", "--json").stdout)
    succeed("export", "scene.yaml", "-o", "transforms.json", "--overwrite")
    again = "check", "scene.yaml", "--json", "-D", "views={transforms: transforms.json}"
    after = json.loads(succeed(*again).stdout)
    assert after | {"iteration_seconds": before["iteration_seconds"]} == before


@pytest.mark.parametrize("suffix", [".npz", ".vdb"])
def test_fields_of_several_files_go_into_one(succeed, suffix):
    values = np.random.default_rng(1).random((4, 5, 6, 3)).astype(np.float32)
    write_field(Path("smoke.albedo.vol"), "albedo", values, np.array([[-0.5] * 3, [0.5] * 3]))
    succeed("export", "density.npz", "smoke.albedo.vol", "-o", f"both{suffix}")
    assert field_names(Path(f"both{suffix}")) == ["density", "albedo"]
    for name, source in (("density", "density.npz"), ("albedo", "smoke.albedo.vol")):
        both, known = (read_field(Path(one), name) for one in (f"both{suffix}", source))
        assert np.array_equal(both.values, known.values)


def test_volumes_that_do_not_go_together(refuse, succeed):
    box = np.array([[-0.5] * 3, [0.5] * 3])
    write_field(Path("other.npz"), "albedo", np.ones((4, 5, 7)), box)
    write_field(Path("moved.npz"), "albedo", np.ones((4, 5, 6)), 2 * box)
    np.savez("nowhere.npz", density=np.ones((2, 2, 2)))
    np.savez("none.npz", bounds=box)
    np.savez("two.npz", density=np.ones((2, 2, 2)), albedo=np.ones((2, 2, 2)), bounds=box)
    for command, words in {
        "density.npz other.npz -o all.npz": "other.npz: has 7 x 5 x 4 cells (x, y, z) in the box",
        "density.npz moved.npz -o all.npz": "cells (x, y, z) in the box [[-1.0",
        "density.npz density.npz -o all.npz": "has a field 'density', and so has a file before it",
        "nowhere.npz -o all.npz": "says no box",
        "none.npz -o all.npz": "has no fields",
        "two.npz -o two.vol": "a .vol holds one field, not density, albedo",
    }.items():
        assert words in refuse(3, "export", *command.split())[-1]
    succeed("export", "two.npz", "-o", "two.vdb")
    assert "two.vdb: already there" in refuse(2, "export", "density.npz", "-o", "two.vdb")[-1]
    succeed("export", "density.npz", "-o", "two.vdb", "--overwrite")


def test_a_run_is_exported_as_it_stands(succeed, refuse):
    """What differs by cell as fields; the rest is printed."""
    succeed("optimize", "scene.yaml", "-o", "run", "-q", "--iterations", "1")
    constants = "sigma_t 6.5 5.5 4.5, albedo 0.923077 0.909091 0.888889, g 0.3"
    assert succeed("export", "run", "-o", "run.vdb").stdout.splitlines() == [
        f"fields: density; the same everywhere, metadata: {constants}",
        "written: run.vdb",
    ]
    told = openvdb_python.described("[grids['density'][n] for n in ('sigma_t', 'g')]", "run.vdb")
    assert told == [[6.5, 5.5, 4.5], pytest.approx(0.3)]
    files = "run.vdb", "run/volumes/density.npz"
    ours, theirs = (read_field(Path(name), "density") for name in files)
    assert np.array_equal(ours.values, theirs.values) and np.array_equal(ours.bounds, theirs.bounds)
    by_cell = "-D", "volume.sigma_s={file: density.npz, name: density}"
    succeed("export", "scene.yaml", "-o", "by_cell.npz", *by_cell)
    assert field_names(Path("by_cell.npz")) == ["density", "sigma_t", "albedo"]
    sought = "optimize.parameters.albedo={init: 0.8, field: true}"
    # From nothing, density comes first.
    start = "optimize.parameters.density={init: 0.5}"
    succeed("optimize", "scene.yaml", "-o", "field", "-q", "-D", sought, "-D", start)
    assert "sigma_t 6.5 5.5 4.5" in succeed("export", "field", "-o", "field.npz").stdout
    assert field_names(Path("field.npz")) == ["density", "albedo"]
    told = refuse(2, "export", "run", "density.npz", "-o", "both.vdb")[-1]
    assert told.startswith("Error: one scene")


@pytest.mark.parametrize(("name", "colors"), [("g", ()), ("albedo", (3,)), ("velocity", (3,))])
def test_z_points_up_where_y_did(succeed, name, colors):
    """Each cell keeps its place in space: (x, y, z) becomes (x, -z, y). So do arrows."""
    values = np.random.default_rng(2).random((2, 3, 4, *colors)).astype(np.float32)
    box = np.array([[-1.0, -2.0, -3.0], [1.0, 2.5, 5.0]])
    write_field(Path("start.npz"), name, values, box)
    succeed("export", "start.npz", "-o", "turned.npz", "--up", "z")
    turned = read_field(Path("turned.npz"), name)
    assert turned.bounds is not None and turned.bounds.tolist() == [[-1, -5, -2], [1, 3, 2.5]]
    for z, y, x in np.ndindex(2, 3, 4):
        center = box[0] + (np.array([x, y, z]) + 0.5) * (box[1] - box[0]) / [4, 3, 2]
        place = np.array([center[0], -center[2], center[1]]) - turned.bounds[0]
        i, j, k = (place / (turned.bounds[1] - turned.bounds[0]) * [4, 2, 3]).astype(int)
        was = values[z, y, x]
        now = [was[0], -was[2], was[1]] if name == "velocity" else was
        assert np.array_equal(turned.values[k, j, i], now)


@pytest.mark.parametrize(
    ("before", "after", "is_same"),
    [("z", "z", True), ("y", "y", True), ("z", "y", False), ("x", "z", False)],
)
def test_a_scene_is_turned_from_its_own_way_up(succeed, before, after, is_same):
    """A column along its way up is one along the way up of the file, as high as before."""
    column = np.zeros((5, 5, 5), np.float32)
    box = np.array([[-1.0] * 3, [1.0] * 3])
    upward = "zyx".index(before)
    column[tuple(slice(2, 5) if axis == upward else 1 for axis in range(3))] = [1, 2, 3]
    box[1, "xyz".index(before)] = 4
    write_field(Path("column.npz"), "density", column, box)
    said = f"volume={{density: {{file: column.npz}}, sigma_t: 1, albedo: 0.5, up: {before}}}"
    succeed("export", "scene.yaml", "-o", "turned.npz", "-D", said, "--up", after)
    turned = read_field(Path("turned.npz"), "density")
    there = np.argwhere(turned.values > 0)
    assert turned.bounds[:, "xyz".index(after)].tolist() == [-1, 4]
    assert there[:, "zyx".index(after)].tolist() == [2, 3, 4]
    assert turned.values[tuple(there.T)].tolist() == [1, 2, 3]
    assert is_same == np.array_equal(turned.values, column)


BOUNDS = np.array([[-1.0, -2.0, -3.0], [1.0, 1.0, 1.0]])


def colored():
    values = np.zeros((2, 3, 4, 3))
    values[0, 0] = [0.5, 1.0, 0.0]
    return values


def test_a_volume(succeed, suffix):
    write_field(Path(f"smoke.albedo{suffix}"), "albedo", colored(), BOUNDS)
    cells, albedo, *more = succeed("info", f"smoke.albedo{suffix}").stdout.splitlines()
    box = "from [-1.0, -2.0, -3.0] to [1.0, 1.0, 1.0]"
    assert cells == f"cells: 4 x 3 x 2 (x, y, z) of 0.5 x 1 x 2 u, {box}"
    assert albedo == "albedo: RGB, 0 to 1, mean 0.08333, more than 0.0001 of the largest in 16.7 %"
    assert more == ["  metadata: class fog volume"] * (suffix == ".vdb")


def test_what_is_no_field_of_the_same_cells_is_named(succeed, refuse):
    """And left out of an export, with a warning; a file of nothing else is refused."""
    others = {"origin": np.zeros(3), "finer": np.ones((4, 4, 4))}
    np.savez("all.npz", density=np.ones((2, 2, 2)), bounds=BOUNDS, **others)
    cells, density, *lines = succeed("info", "all.npz").stdout.splitlines()
    assert cells.startswith("cells: 2 x 2 x 2") and density.startswith("density: gray, 1 to 1")
    starts = [
        f"no field: {name} {why}"
        for name, why in zip(others, ("has shape [3]", "has 4 x 4"), strict=True)
    ]
    assert all(line.startswith(start) for line, start in zip(lines, starts, strict=True))
    said = json.loads(succeed("info", "all.npz", "--json").stdout)
    assert list(said["fields"]) == ["density"] and list(said["no_fields"]) == list(others)
    result = succeed("export", "all.npz", "-o", "out.vdb")
    assert [line.split()[4] for line in result.stderr.splitlines()] == list(others)
    assert field_names(Path("out.vdb")) == ["density"]
    np.savez("none.npz", origin=others["origin"])
    assert "origin has shape [3]" in refuse(3, "info", "none.npz")[-1]


def test_a_haze_counts_as_empty(succeed):
    """Of less than a ten thousandth of the largest, as an optimization leaves it."""
    haze = np.geomspace(1e-19, 0.9e-4, 24).reshape(2, 3, 4)
    haze[0, 0, :2] = 1, 1.1e-4
    write_field(Path("smoke.npz"), "density", 7 * haze, BOUNDS)
    assert "more than 0.0001 of the largest in 8.33 %" in succeed("info", "smoke.npz").stdout


def test_the_volume_of_a_scene(succeed):
    """Its fields as their file has them, and what is the same everywhere."""
    override = ["-D", "volume.density={file: density.npz}"]
    report = json.loads(succeed("info", "density.npz", "--json").stdout)
    field = report["fields"]["density"]
    assert report["resolution"] == [6, 5, 4] and field["colors"] == field["filled"] == 1
    assert 0 < field["min"] < field["mean"] < field["max"] < 1
    lines = succeed("info", "scene.yaml", *override).stdout.splitlines()
    assert lines[:2] == succeed("info", "density.npz").stdout.splitlines()
    assert [line.split(":")[0] for line in lines[2:]] == ["sigma_t", "albedo", "g"]
    assert all(line.endswith(" everywhere") for line in lines[2:])


def test_an_image(succeed):
    np.save("picture.npy", np.concatenate([np.full((4, 5, 3), 2.0), np.zeros((4, 5, 3))]))
    line = "image: 5 x 8 pixels, gray, linear radiance 0 to 2, mean 1, not 0 in 50 %\n"
    assert succeed("info", "picture.npy").stdout == line
