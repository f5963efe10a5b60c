"""Scene files as records: each rule of the schema, told with line, column and key."""

import math
from operator import sub
from pathlib import Path

import pytest
import yaml
from example_scene import CAMERA, SCENE, changed, volume

from ddrecon.scene import upright_axis
from ddrecon.scene_file.build import build_scene
from ddrecon.scene_file.load import (
    describe,
    dump_scene,
    read_scene,
    referenced_files,
    ring_cameras,
)
from ddrecon.scene_file.schema import AmbientSection, Bounds, DirectionalSection, VolumeSection
from ddrecon.scene_file.view_schema import PerspectiveSection, RingSection
from ddrecon.settings import FieldFile, OptimizeSettings, ParameterSettings, RenderSettings

CONTRACT = """\
volume:
  bounds: {min: [-0.5, -0.75, -0.5], max: [0.5, 0.75, 0.5]}
  resolution: [64, 96, 64]    # cells in x, y, z; may be left out where a field's file gives it
  density: {file: plume.npz}               # or {constant: 0.1}; fields and constants mix freely
  # either sigma_a + sigma_s, or sigma_t + albedo; number, [r,g,b] or {file: ...}
  sigma_a: 0.6
  sigma_s: [11.4, 10.8, 9.6]
  g: 0.3
lights:
  # direction = the way the light travels
  - {type: directional, direction: [-2, -2, -1], irradiance: 3.14159}
  - {type: ambient, radiance: [0.2, 0.3, 0.5]}    # the same from everywhere
views:
  - name: front
    image: targets/front.exr
    mask: targets/front_mask.png           # black = ignore these pixels
    split: train                           # or test: never optimised on, always reported
    camera:
      {type: perspective, origin: [0, 0.3, 3.2], target: [0, 0, 0], up: [0, 1, 0], fov: 28,
       resolution: [128, 128]}
render: {samples_per_pixel: 1, steps_per_voxel: 1, background: true}
diffusion:
  model: p1                # none | p1 | flux_limited
  scheme: conservative     # or `printed`: the paper's own central differences, for comparison
  closure: smooth          # empty-space treatment, see THEORY section 5
  tolerance: 1e-4          # relative residual
  warm_start: true
  transport_rounds: 0
optimize:
  iterations: 300
  loss: l2                 # l2 | l1 | huber | relative_l2
  parameters:
    density: {init: 0.0, min: 0, tv: 1e-4}
"""


def test_the_example_of_the_contract(read, tmp_path):
    tree = read(CONTRACT).tree
    box, density = Bounds((-0.5, -0.75, -0.5), (0.5, 0.75, 0.5)), FieldFile(tmp_path / "plume.npz")
    medium = {"sigma_a": 0.6, "sigma_s": (11.4, 10.8, 9.6), "g": 0.3}
    assert tree.volume == VolumeSection(density, bounds=box, resolution=(64, 96, 64), **medium)
    sun = DirectionalSection((-2, -2, -1), 3.14159)
    assert tree.lights == (sun, AmbientSection((0.2, 0.3, 0.5)))
    assert tree.views[0].image == tmp_path / "targets/front.exr" and tree.views[0].split == "train"
    assert tree.diffusion.tolerance == 1e-4 and tree.render == RenderSettings(steps_per_voxel=1)
    density = ParameterSettings(init=0.0, min=0.0, tv=1e-4)
    assert tree.optimize == OptimizeSettings({"density": density}, 300, loss="l2")


def test_every_error_is_told_at_once_with_its_place(refusal):
    text = SCENE.replace("g: 0.3", "g: 1").replace("density:", "densty:")
    text = text.replace("fov: 28", "fov: 0")
    lines = refusal(text, "render.steps_per_voxel=1.5", "lights.5.radiance=1")
    assert lines == [
        "-D lights.5.radiance=1: lights.5: no such entry: lights is a list of 2, counted from 0",
        "scene.yaml:2:3: volume: missing key 'density'",
        "scene.yaml:4:3: volume.densty: unknown key; did you mean 'density'?",
        "scene.yaml:7:6: volume.g: must be below 1, found 1",
        "scene.yaml:12:94: views.0.camera.fov: must be above 0, found 0",
        "-D render.steps_per_voxel=1.5: render.steps_per_voxel: expected a whole number, found 1.5",
    ]


def test_left_out_names_count_from_zero_and_all_are_unique(read, refusal):
    views = f"views:\n  - {{name: view_01, camera: {CAMERA}}}\n  - {{camera: {CAMERA}}}\n"
    text = SCENE[: SCENE.index("views:")] + views
    assert refusal(text) == ["scene.yaml:13:5: views.1: 'view_01' is already the name of view 0"]
    views = read(text, "views.0.name=view_02").tree.views
    assert [view.name for view in views] == ["view_02", "view_01"]


def test_overrides_replace_add_and_reach_into_lists(read):
    overrides = ["volume.g=0.5", "lights.1.radiance=[1, 2, 3]", "volume.g=0.6", "render={}"]
    overrides += ["optimize.parameters.density.tv=1e-2"]
    tree = read(SCENE, *overrides).tree
    assert tree.volume.g == 0.6 and tree.lights[1] == AmbientSection((1, 2, 3))
    assert tree.optimize is not None and tree.optimize.parameters["density"].tv == 0.01


RING = {"count": 1, "radius": 3, "fov": 30}
OWN = ["shoot/own.npz", "shoot/r0.npy"]
"""Files of a scene in the folder `shoot`."""
TYPED = {
    "volume.density={file: a.npz}": ["a.npz", OWN[1]],
    "volume.density.file=b/../a.npz": ["b/../a.npz", OWN[1]],
    "lights=[{type: ambient, radiance: 1}, {type: environment, file: sky.npy}]": ["sky.npy", *OWN],
    f"views=[{{image: front.npy, camera: {CAMERA}}}]": ["front.npy", OWN[0]],
    f"views={{ring: {RING}, images: 'r*.npy'}}": ["r0.npy", OWN[0]],
    f"views.ring={RING}": OWN,
    "views.images=r?.npy": ["r0.npy", OWN[0]],
}


@pytest.mark.parametrize(("override", "files"), TYPED.items())
def test_paths_that_are_typed_start_at_the_current_folder(tmp_path, monkeypatch, override, files):
    """Those of the scene start at its folder, as ever."""
    monkeypatch.chdir(tmp_path)
    Path("shoot").mkdir()
    for picture in ("r0.npy", "shoot/r0.npy"):
        Path(picture).touch()
    views = {"ring": RING, "images": "r*.npy"}
    Path("shoot/scene.yaml").write_text(volume(density={"file": "own.npz"}, views=views))
    named = referenced_files(read_scene("shoot/scene.yaml", [override]))
    assert {*named} == {tmp_path / file for file in files}


@pytest.mark.parametrize("name", ["lights.0.irradiance", "views.front.camera", "g"])
def test_overrides_add_parameters_whose_names_have_dots(read, name):
    text = SCENE + "optimize: {parameters: {density: {}}}\n"
    optimize = read(text, f"optimize.parameters.{name}.max=0.5").tree.optimize
    assert optimize is not None and optimize.parameters[name].max == 0.5
    optimize = read(text, f"optimize.parameters.{name}={{}}").tree.optimize
    assert optimize.parameters.keys() == {"density", name}


def test_marks_lead_later_errors_to_the_line(read):
    scene_file = read(SCENE, "volume.g=0.1")
    for key, place in {"lights.1.radiance": "10:31", "views.0.image.never.written": "12:5"}.items():
        line = str(scene_file.refused(key, "odd"))
        assert line.endswith(f"scene.yaml:{place}: {key}: odd")
    assert str(scene_file.refused("volume.g", "odd")) == "-D volume.g=0.1: volume.g: odd"


MATRIX = [[0.0, 0.0, 1.0, 2.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
FLAT = {"type": "orthographic", "width": 2, "matrix": MATRIX, "resolution": [4, 4]}


@pytest.mark.parametrize("text", [SCENE, CONTRACT, changed(views=[{"camera": FLAT}])])
def test_a_dumped_scene_reads_back_as_the_same_tree(read, text, tmp_path):
    overrides = ["views.0.name='1e5'", "diffusion.tolerance=1e-5"]
    overrides += ["optimize.parameters.density={init: {file: a b.npz}, max: 7}"]
    scene_file = read(text, *overrides)
    (tmp_path / "elsewhere").mkdir()
    dump_scene(describe(scene_file), tmp_path / "elsewhere" / "scene.yaml")
    assert read_scene(tmp_path / "elsewhere" / "scene.yaml").tree == scene_file.tree
    assert "support_margin" not in (tmp_path / "elsewhere" / "scene.yaml").read_text()


# Rings of cameras: where they stand, and which images are theirs.

CIRCLE = {"count": 3, "radius": 3.2, "height": 0.3, "fov": 28, "resolution": [8, 6]}


@pytest.mark.parametrize("up", range(3))
def test_a_ring_goes_around_its_target_about_the_way_up(up):
    """From the axis after it, x, y, z and x again, towards the one after that."""
    upright, ahead, aside = up, (up + 1) % 3, (up + 2) % 3
    along = (float(up == 0), float(up == 1), float(up == 2))
    ring = RingSection(count=10, radius=2, fov=30, target=(1, 2, 3), height=0.5)
    cameras = ring_cameras(ring, "xyz"[up])
    offsets = [tuple(map(sub, camera.origin or (), ring.target)) for camera in cameras]
    assert offsets[0][ahead] == 2 and offsets[1][aside] > 0 > offsets[-1][aside]
    for camera, offset in zip(cameras, offsets, strict=True):
        assert offset[upright] == 0.5
        assert math.hypot(offset[ahead], offset[aside]) == pytest.approx(2)
        same = {"origin": camera.origin, "target": (1, 2, 3), "up": along, "fov": 30}
        assert camera == PerspectiveSection(**same)
    turns = [math.dist(offsets[i - 1], offsets[i]) for i in range(10)]
    assert turns == pytest.approx([4 * math.sin(math.pi / 10)] * 10)


@pytest.mark.parametrize("up", "xyz")
def test_the_volume_says_what_is_up(read, up):
    axis, volume = "xyz".index(up), yaml.safe_load(SCENE)["volume"] | {"up": up}
    scene_file = read(changed(volume=volume, views={"ring": CIRCLE}))
    assert upright_axis(build_scene(scene_file)) == axis
    views = scene_file.tree.views
    assert [view.camera.origin[axis] for view in views] == [CIRCLE["height"]] * 3


def test_ring_views_have_names_and_no_images(read, tmp_path):
    scene_file = read(changed(views={"ring": CIRCLE, "test_every": 2}))
    views = scene_file.tree.views
    assert [view.name for view in views] == ["ring_00", "ring_01", "ring_02"]
    assert [view.split for view in views] == ["test", "train", "test"]
    assert all(view.image is None for view in views)
    dump_scene(describe(scene_file), tmp_path / "dump.yaml")
    assert read_scene(tmp_path / "dump.yaml").tree == scene_file.tree


@pytest.mark.parametrize(
    "names",
    [
        *(["a", "b", "c"], ["2", "10", "11"], ["09", "10", "100"], ["1_10", "2_1", "2_9"]),
        *(["0.25", "0.50", "1.00"], ["a-2", "a-9", "a-10"]),
    ],
)
@pytest.mark.parametrize("pattern", ["targets/t_*.exr", "targets\\t_*.exr"])
def test_images_are_in_order_of_their_numbers(read, tmp_path, names, pattern):
    """Of files alone, which are relative to the scene."""
    (tmp_path / "targets").mkdir()
    paths = [tmp_path / "targets" / f"t_{name}.exr" for name in names]
    for path in reversed(paths):
        path.touch()
    (tmp_path / "targets" / "t_d.exr").mkdir()
    views = read(changed(views={"ring": CIRCLE, "images": pattern})).tree.views
    assert [view.image for view in views] == paths


@pytest.mark.parametrize("names", [["0.25", "0.5", "1"], ["-30", "0", "30"], ["1.9", "1.10", "2"]])
def test_an_order_that_is_not_plain_is_refused(refusal, tmp_path, names):
    for name in names:
        (tmp_path / f"t_{name}.exr").touch()
    (line,) = refusal(changed(views={"ring": CIRCLE, "images": "t_*.exr"}))
    assert "views.images: 't_*.exr' matches names with fractions or signs" in line
