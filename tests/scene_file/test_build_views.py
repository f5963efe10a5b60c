"""The views section: cameras, pictures and frames; whether cameras see the box, and why not."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from example_scene import SCENE, VIEW, changed
from film_files import H264, write_film
from hypothesis import given
from hypothesis import strategies as st

from ddrecon.cameras import Camera, Rays, look_at
from ddrecon.errors import SceneError
from ddrecon.grid import Grid
from ddrecon.march.samplers import cross_box
from ddrecon.scene_file.build import load_scene
from ddrecon.scene_file.build_views import explain_blindness, require_frames, sees_box


def problems(path, *overrides):
    with pytest.raises(SceneError) as caught:
        load_scene(path, overrides=overrides)
    return [line.replace(f"{path.parent}/", "") for line in caught.value.problems]


def test_an_absent_file_is_the_scenes_mistake(write):
    path = write(
        SCENE.replace("{constant: 0.1}", "{file: none.npz}")
        + "optimize: {parameters: {density: {init: {file: no.npz}}}}\n"
    )
    assert problems(path, "views.0.image=no.exr", "views.0.mask=.") == [
        "scene.yaml:4:19: volume.density.file: none.npz does not exist",
        "-D views.0.image=no.exr: views.0.image: no.exr does not exist",
        f"-D views.0.mask=.: views.0.mask: {path.parent} is not a file",
        "scene.yaml:13:48: optimize.parameters.density.init.file: no.npz does not exist",
    ]


def test_images_become_channels_first_and_give_the_resolution(load, tmp_path):
    pixels = np.random.default_rng(0).random((6, 8, 3)).astype(np.float32)
    np.save(tmp_path / "a.npy", pixels)
    np.save(tmp_path / "m.npy", np.eye(6, 8))
    camera = {name: value for name, value in VIEW["camera"].items() if name != "resolution"}
    pictures = {"image": "a.npy", "mask": "m.npy", "split": "test", "camera": camera}
    (view,) = load(changed(views=[VIEW | pictures])).views
    assert view.image is not None and np.array_equal(view.image, np.moveaxis(pixels, -1, 0))
    assert view.mask is not None and np.array_equal(view.mask, np.eye(6, 8))
    assert view.camera.size == (6, 8) and view.is_test and view.name == "front"


def test_cameras(load):
    matrix = [[0, 0, 1, 2], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
    flat = {"type": "orthographic", "width": 3, "pixel_aspect": 1.25, "resolution": [8, 6]}
    views = load(changed(views=[VIEW, {"camera": flat | {"matrix": matrix}}])).views
    perspective, orthographic = (view.camera for view in views)
    assert perspective.half_width == pytest.approx(math.tan(math.radians(14)))
    assert perspective.is_perspective
    assert perspective.pose[:, 3].tolist() == pytest.approx([0, 0.3, 3.2])
    assert orthographic.half_width == 1.5 and not orthographic.is_perspective
    assert orthographic.pose.tolist() == matrix[:3] and orthographic.pixel_aspect == 1.25


def test_cameras_that_all_miss_the_volume_are_one_problem(write):
    ring = {"count": 3, "radius": 3, "fov": 20, "target": [9, 0, 0], "resolution": [4, 4]}
    (line,) = problems(write(changed(views={"ring": ring})))
    assert line.startswith("scene.yaml:")
    assert "no pixel of view 'ring_00' and 2 more looks through the volume; the camera" in line


# Whether cameras see the box

GRID = Grid.from_xyz((1, 1, 1), (-1, -2, -3), (1, 2, 3))
"""In array order the box is (-3, -2, -1) to (3, 2, 1)."""
POINT = st.tuples(*[st.floats(-6, 6, width=32)] * 3)
UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


@given(origin=POINT, direction=POINT)
def test_marching_along_the_ray_agrees(origin, direction):
    length = torch.tensor(direction).norm()
    if length > 0.1:
        unit = torch.tensor(direction) / length
        points = (torch.tensor(origin) + torch.linspace(0, 20, 2001)[:, None] * unit).abs()
        ray = Rays(torch.tensor([origin]), unit[None], None)
        is_hit = cross_box(GRID, ray).hit.numel() > 0
        sides = torch.tensor([3.0, 2.0, 1.0])
        assert is_hit or not bool((points < sides - 0.01).all(dim=1).any())
        assert not is_hit or bool((points < sides + 0.02).all(dim=1).any())


@pytest.mark.parametrize(
    ("target", "size", "expected"),
    [
        ([0.0, 0.0, 0.0], (33, 17), True),
        ([0.0, 0.0, 90.0], (33, 17), False),
        ([40.0, 0.0, 0.0], (1, 1), False),
        ([-0.12, 0.0, 0.0], (1, 2001), True),  # in one pixel of many
    ],
)
def test_a_camera_sees_the_box(target, size, expected):
    eye = torch.tensor([0.0, 0.0, 200.0 if size[1] > 100 else 20.0])
    pose = look_at(eye, torch.tensor(target), torch.tensor([0.0, 1.0, 0.0]))
    assert sees_box(Camera(pose, size, 0.1), GRID) is expected


def inverse(pose):
    return torch.linalg.inv(torch.cat([pose, pose.new_tensor([[0, 0, 0, 1]])]))[:3]


def as_opencv(pose):
    return pose * torch.tensor([1.0, -1, -1, 1])


def turned(sign):
    """The world turned about x, after the box is moved to where that shows."""
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -sign], [0, sign, 0]], dtype=torch.float64)
    return lambda pose: turn @ pose


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (as_opencv, "OpenCV axes (right, down, forward): negate"),
        (inverse, "world to camera: give the inverse"),
        (lambda pose: inverse(as_opencv(pose)), "world to camera with OpenCV axes"),
        (turned(1), "z up, as in Blender, in a scene with y up"),
        (turned(-1), "y up in a scene with z up"),
        (lambda pose: pose * torch.tensor([1.0, 1, 1, 1000]), "check its target, field of view"),
        (lambda pose: pose + 90 * torch.eye(3, 4)[:, [3, 3, 3, 0]], "the camera looks past it"),
    ],
)
def test_the_mistake_is_named_that_blinds_all_cameras(mistake, words):
    grid = Grid.from_xyz((1, 1, 1), (9, 8, 7), (11, 12, 13))
    center = torch.tensor(grid.center_xyz, dtype=torch.float64)
    eyes = torch.tensor([[9.0, 1, 20], [-8, 3, 19], [18, -4, 6]], dtype=torch.float64)
    seeing = [Camera(look_at(center + eye, center, UP), (9, 9), 0.1) for eye in eyes]
    assert all(sees_box(camera, grid) for camera in seeing)
    blind = [replace(camera, pose=mistake(camera.pose)) for camera in seeing]
    assert not any(sees_box(camera, grid) for camera in blind)
    assert words in explain_blindness(blind, blind, grid)


def test_cameras_that_see_the_box_by_chance_are_asked_as_well():
    """World to camera read as camera to world: some of many look at the box all the same."""
    middle = torch.tensor(GRID.center_xyz, dtype=torch.float64)
    turns = [0.4 + 0.8 * index for index in range(7)]
    eyes = [torch.tensor([math.cos(a), 0.4, math.sin(a)]) for a in turns]
    poses = [look_at(middle + 9 * eye.double(), middle, UP) for eye in eyes]
    cameras = [Camera(inverse(as_opencv(pose)), (9, 12), 0.3) for pose in poses]
    blind = [camera for camera in cameras if not sees_box(camera, GRID)]
    assert 0 < len(blind) < len(cameras)
    assert "world to camera with OpenCV axes" in explain_blindness(blind, cameras, GRID)


# Films of one scene are counted together, so they must be shown together.


@pytest.mark.parametrize(
    ("rate", "shift", "frames", "later", "apart"),
    [
        ("25", "0", (0, 30), {"time": 0.3}, ""),
        ("30", "0", (0, 30), {}, "30 frames a second and front.mp4 25: .* 0.2 s apart"),
        ("30", "0", (3, 3), {"time": 0.3}, " 0.02 s apart"),
        ("25", "gte(N,20)*5", (0, 30), {}, " 0.2 s apart"),
        ("25", "gte(N,20)*0.3", (0, 30), {}, ""),
    ],
)
def test_films_of_other_rates_are_refused(read, tmp_path, rate, shift, frames, later, apart):
    write_film(tmp_path / "front.mp4", 40, "25", *H264)
    write_film(tmp_path / "side.mov", 45, rate, *H264, shift=shift)
    views = [{"image": name, "camera": VIEW["camera"]} for name in ("front.mp4", "side.mov")]
    views[1] |= later
    first, last = frames
    scene_file = read(changed(views=views, frames={"first": first, "last": last}))
    if not apart:
        require_frames(scene_file)
        return
    with pytest.raises(SceneError, match=rf"views\.1\.image: side\.mov has .*{apart}"):
        require_frames(scene_file)
