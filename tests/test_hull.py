"""A box is compared with what pictures show: how they differ, why, and what to write."""

import math
from collections.abc import Callable

import pytest
import torch
from media import make_scene, random_values

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.hull import bound_smoke, bounds_text, doubt_box
from ddrecon.picture import render
from ddrecon.scene import View, place_turntable, upright_axis

BOX = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.8, 0.5]])
SMOKE = torch.tensor([[0.1, 0.1, 0.12], [0.4, 0.6, 0.4]])
FAULTS: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], list[str]]] = {
    "none": (lambda box: box, []),
    "moved": (lambda box: box + torch.tensor([0.0, 0.0, -0.5]), ["no overlap"]),
    "hardly there": (
        lambda box: box - torch.tensor([0.0, 0.0, 0.39]),
        ["hardly any overlap", "3.6 %"],
    ),
    "cut": (lambda box: box - torch.tensor([0.0, 0.4, 0.0]), ["cut off", "below 0 along y"]),
    "cut on all sides": (
        lambda _: torch.tensor([[0.05, 0.0, 0.05], [1.2, 1.6, 1.2]]),
        ["cut off"],
    ),
    "short": (lambda box: box / 100, ["far too large"]),
    "small": (lambda box: 10 * (box - 0.25), ["far too small"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_box_that_is_off_is_doubted_and_a_better_one_named(fault):
    change, words = FAULTS[fault]
    shown = change(SMOKE)
    doubt = doubt_box(shown, BOX)
    assert (doubt is None) == (not words)
    for word in words:
        assert word in str(doubt) and bounds_text(shown) in str(doubt)


def test_the_box_of_what_cameras_show_holds_it_and_hardly_more():
    """A square within 0.3 of the middle, by parallel rays along z, y and x."""
    eyes, origin = 3 * torch.eye(3).double(), torch.zeros(3).double()
    cameras = [Camera(look_at(eye, origin, eye.roll(1)), (40, 40), 1.0, False) for eye in eyes]
    shown = torch.zeros(40, 40, dtype=torch.bool)
    shown[14:26, 14:26] = True
    views = [View("view", camera) for camera in cameras]
    low, high = bound_smoke([(views, [shown] * 3)], 0.0)
    assert float(low.max()) <= -0.3 and float(high.min()) >= 0.3
    assert float(high.max()) < 0.35
    torch.testing.assert_close(low, -high)


CENTER = (0.1, -0.2, 0.3)


def looking(origin, up):
    vectors = (torch.tensor(vector, dtype=torch.float64) for vector in (origin, CENTER, up))
    return Camera(look_at(*vectors), (4, 5), 0.3)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turn_is_rigid_about_the_line_through_the_center(axis):
    camera, angle = looking((2.0, 1.0, -1.5), (0.3, 0.8, 0.5)), 2 * math.pi / 9
    scene = make_scene(random_values(4, 5, 6))
    scene.up = axis
    moved = place_turntable(scene, View("view", camera), 9)[1].camera
    change = moved.pose[:, :3] @ camera.pose[:, :3].T
    middle = torch.tensor(scene.volume.grid.center_xyz, dtype=torch.float64)
    along = torch.eye(3, dtype=torch.float64)[axis]
    assert torch.allclose(change @ change.T, torch.eye(3, dtype=torch.float64), atol=1e-14)
    assert torch.allclose(change @ along, along, atol=1e-14)
    assert float(change.trace()) == pytest.approx(1 + 2 * math.cos(angle))
    before, after = (each.pose[:, 3] - middle for each in (camera, moved))
    assert torch.allclose(after, change @ before, atol=1e-14)


@pytest.mark.parametrize(
    ("up", "axis"), [((1.0, 0.1, 0), 0), ((0, 1.0, 0.2), 1), ((0.2, 0, -1.0), 2)]
)
def test_the_upright_axis_is_the_scenes_or_the_one_the_cameras_agree_on(up, axis):
    origins = [(3.0, 0.4, 2.0), (-2.0, 0.3, 3.0), (-2.5, 3.0, -2.0)]
    scene = make_scene(random_values(4, 5, 6))
    scene.views = [View("view", looking(origin, up)) for origin in origins]
    assert upright_axis(scene) == axis
    for scene.up in range(3):
        assert upright_axis(scene) == scene.up


def test_a_ring_begins_at_its_view_and_goes_once_around():
    scene = make_scene(random_values(4, 5, 6))
    views = place_turntable(scene, scene.views[0], 8)
    assert [view.name for view in views] == [f"ring_{index:03d}" for index in range(8)]
    assert torch.allclose(views[0].camera.pose, scene.views[0].camera.pose, atol=1e-15)
    again = place_turntable(scene, views[7], 8)[1].camera.pose
    assert torch.allclose(again, views[0].camera.pose, atol=1e-14)


def test_a_volume_turned_by_a_quarter_looks_the_same_to_a_camera_turned_with_it():
    density, grid = random_values(5, 4, 5), Grid((5, 4, 5), (-0.3, -0.6, -0.5), (0.7, 0.4, 0.5))
    sky = {"directional": None, "ambient": (1.0,)}
    scene = make_scene(density, grid=grid, **sky)
    # What was along z is along x, what was along x along -z.
    turned = density.transpose(0, 2).flip(0).contiguous()
    other = make_scene(turned, grid=grid, **sky)
    other.views = place_turntable(scene, scene.views[0], 4)
    assert torch.allclose(render(scene), render(other, "ring_001"), atol=1e-9)
