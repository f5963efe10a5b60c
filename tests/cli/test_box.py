"""`volume: {bounds: auto, resolution: auto}`: what pictures leave room for, in numbers."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from ddrecon.cameras import cast_rays, pixel_width
from ddrecon.scene_file.build import load_scene
from ddrecon.scene_file.load import describe, dump_scene, read_scene

pytestmark = pytest.mark.usefixtures("untimed")
RADIUS, CENTERS = 0.2, ((0.1, 0.3, -0.2), (0.1, 0.5, -0.2))
WIDTH, HEIGHT = 54, 42
SCENE = """\
frames: {first: 0, last: 1}
volume: {bounds: auto, resolution: auto, density: 0, sigma_t: 8, albedo: 0.9}
lights: [{type: directional, direction: [-1, -2, -1], irradiance: 2.5}]
diffusion: {model: none}
optimize: {parameters: {density: {init: 0}}}
views:
"""
LENSES = {
    "pinhole": "type: perspective, fov: 40",
    "parallel": "type: orthographic, width: 1.8",
    "opencv": "type: perspective, fov: 40, distortion: {type: opencv, k1: -0.2, p1: 0.002}",
}
PLACES = ((0, 0.3, 2.5), (-2.2, 0.9, 1.0), (2.3, 0.1, 0.5))


@pytest.fixture
def scene(folder):
    """Writes a film of a ball in two places, before what pictures show without it."""

    def write(lens="pinhole", behind=0, ball=0.5, more="", radius=RADIUS):
        views = [
            f"  - {{name: v{i}, image: 'v{i}_{{frame}}.npy', {more} camera: {{{LENSES[lens]}, "
            f"origin: {list(place)}, target: [0, 0.3, 0], resolution: [{WIDTH}, {HEIGHT}]}}}}"
            for i, place in enumerate(PLACES)
        ]
        path = folder / "auto.yaml"
        path.write_text(SCENE + "\n".join(views) + "\n")
        generator = np.random.default_rng(1)
        for frame, center in enumerate(CENTERS):
            for i in range(len(PLACES)):
                np.save(f"v{i}_{frame}.npy", np.zeros((HEIGHT, WIDTH, 3), np.float32))
            box = "volume.bounds={min: [-1, -1, -1], max: [1, 1, 1]}"
            sized = load_scene(path, overrides=[box, "volume.resolution=[4, 4, 4]"])
            for i, view in enumerate(sized.views):
                rays = cast_rays(view.camera)
                away = torch.tensor(center[::-1]) - rays.origin
                along = (away * rays.direction).sum(1, keepdim=True)
                hits = (away - along * rays.direction).norm(dim=1) < radius
                picture = torch.where(hits, ball, behind).numpy().reshape(HEIGHT, WIDTH, 1)
                picture = picture + 0.002 * generator.standard_normal((HEIGHT, WIDTH, 3))
                np.save(f"v{i}_{frame}.npy", picture.astype(np.float32))
        return path

    return write


@pytest.mark.parametrize("lens", LENSES)
def test_a_box_holds_what_is_seen_and_little_more(scene, lens):
    """In all frames; and scenes with what was found are as any."""
    path = scene(lens)
    found = read_scene(path)
    volume, views = found.tree.volume, load_scene(path).views
    pixel = float(
        np.mean([pixel_width(view.camera, torch.tensor(CENTERS[0]), 0.0) for view in views])
    )
    for axis in range(3):
        low, high = (end([c[axis] for c in CENTERS]) for end in (min, max))
        # Two pixels on each side are asked for, and the ball seen through a cell is in all of it.
        ends = low - RADIUS - volume.bounds.min[axis], volume.bounds.max[axis] - RADIUS - high
        assert pixel < min(ends) <= max(ends) < 9 * pixel
    cells = np.subtract(volume.bounds.max, volume.bounds.min) / volume.resolution
    np.testing.assert_allclose(cells, 2 * pixel, rtol=0.05)
    np.testing.assert_allclose(cells, cells[0], rtol=1e-6)
    dump_scene(describe(found), Path("plain.yaml"))
    assert "bounds: auto" not in Path("plain.yaml").read_text()
    assert read_scene("plain.yaml").tree == found.tree


@pytest.mark.parametrize("periodic", [False, True])
def test_cells_of_a_box_in_numbers_are_cubes_but_for_its_period(scene, periodic):
    """The box keeps its lower corner, and grows by less than a cell."""
    low, high = np.array([-1.0, -0.9, -0.8]), np.array([1.0, 1.13, 0.97])
    box = f"{{min: {low.tolist()}, max: {high.tolist()}}}"
    along = ["volume.periodic=[x]"] if periodic else []
    volume = read_scene(scene(), [f"volume.bounds={box}", *along]).tree.volume
    bounds = np.array([volume.bounds.min, volume.bounds.max])
    cells = (bounds[1] - bounds[0]) / volume.resolution
    np.testing.assert_allclose(cells[1:], cells[1], rtol=1e-6)
    assert np.array_equal(bounds[0], low)
    grown = (bounds[1] - high) / cells
    assert (grown >= -1e-9).all() and (grown < 1).all()
    assert (
        (bounds[1, 0] == high[0] and cells[0] < cells[1])
        if periodic
        else cells[0] > 0.99 * cells[1]
    )


def test_dark_smoke_before_something_bright_has_the_box_of_bright_smoke(scene, run):
    bright = read_scene(scene()).tree.volume
    dark = scene(behind=0.9, ball=0.4, more="background: 0.9,")
    assert read_scene(dark).tree.volume == bright
    np.save("empty.npy", np.full((HEIGHT, WIDTH, 3), 0.9, np.float32))
    dark = scene(behind=0.9, ball=0.4, more="background: empty.npy,")
    assert read_scene(dark).tree.volume == bright
    told = run("check", "auto.yaml").stdout
    assert f"from {list(bright.bounds.min)} to {list(bright.bounds.max)}" in told
    assert "what they show fits in bounds: {min: [" in told
    least, most = re.search("cells: (.*) to (.*) pixels wide", told).groups()
    assert float(least) < 2 < float(most)


@pytest.mark.parametrize(
    ("make", "overrides", "line"),
    [
        ({"behind": 0.9, "radius": 0.5}, [], "view 'v0' shows something along most of its edges,"),
        ({}, [f"views.{i}.split=test" for i in range(3)], "no training views all show something"),
        ({}, [f"views.{i}.split=test" for i in range(2)], "the views leave it open; more from oth"),
        ({"behind": 0.9}, [], "no training views all show something: give background where"),
        ({}, ["views.0.camera.target=[0, 6, 0]"], "of each place some view shows nothing"),
        ({}, ["volume.bounds=null"], "volume.resolution: auto takes volume.bounds, a box in num"),
        ({}, ["frames.last=2"], "does not exist"),
    ],
)
def test_what_pictures_do_not_tell_is_asked_for(scene, refuse, make, overrides, line):
    scene(**make)
    (told, *_) = refuse(2, "check", "auto.yaml", *(word for o in overrides for word in ("-D", o)))
    assert line in told


def test_smoke_outside_of_the_box_is_refused_and_far_off_is_told(scene, run, refuse):
    """By `check` and, where the support is asked for, before anything is optimized."""
    box = "volume.bounds={{min: [{0}, 0, {0}], max: [{1}, 1, {1}]}}"
    scene()
    still = (
        "frames=null",
        "volume.resolution=[8, 8, 8]",
        *(f"views.{i}.image=v{i}_0.npy" for i in range(3)),
    )
    options = ["auto.yaml", *(word for override in still for word in ("-D", override))]
    auto = "-D", "optimize.parameters.density.support=auto"
    away = *options, "-D", box.format(0.45, 0.9)
    refused = [refuse(2, "check", *away), refuse(2, "check", *away, *auto)]
    refused.append(refuse(2, "optimize", *away, *auto, "-o", "run"))
    assert all("volume.bounds: no overlap" in told[-1] for told in refused)
    assert "max: [" in refused[0][-1] and not Path("run").exists()
    told = run("check", *options, "-D", box.format(-9, 9))
    assert told.exit_code == 0 and "volume.bounds: far too large" in told.stderr


def test_cells_far_wider_than_pixels_and_far_too_many_are_told(scene, run, monkeypatch):
    """With how many pixels a run averages; `auto` takes wider ones."""
    scene()
    told = run("check", "auto.yaml", "-D", "volume.resolution=[2, 2, 2]").stdout
    (width,) = re.findall("cells: (.*) to", told)
    size = int(float(width) / 2)
    assert f"averages {size} x {size} pixels" in told
    assert "averages" not in run("check", "auto.yaml").stdout
    x, y, z = read_scene("auto.yaml").tree.volume.resolution
    monkeypatch.setattr("ddrecon.scene_file.build_views.MANY_CELLS", x * y * z // 8 + 1)
    told = run("check", "auto.yaml").stderr
    assert f"{x * y * z:,} cells two pixels wide take hours: they are 2 times as wide" in told
    assert told.count("take hours") == 1
    wider = read_scene("auto.yaml").tree.volume.resolution
    assert np.abs(2 * np.array(wider) - [x, y, z]).max() <= 2
