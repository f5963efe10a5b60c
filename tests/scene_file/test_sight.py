"""Whether cameras see the volume's box, and why they do not."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ddrecon.cameras import Camera, Rays, look_at
from ddrecon.grid import Grid
from ddrecon.march.box import cross_box
from ddrecon.scene_file.build_views import explain_blindness, sees_box

GRID = Grid.from_xyz((1, 1, 1), (-1, -2, -3), (1, 2, 3))
"""In array order the box is (-3, -2, -1) to (3, 2, 1)."""
POINT = st.tuples(*[st.floats(-6, 6, width=32)] * 3)
UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


@given(origin=POINT, direction=POINT)
def test_marching_along_the_ray_agrees(origin: tuple[float, ...], direction: tuple[float, ...]):
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
def test_cameras(target: list[float], size: tuple[int, int], expected: bool) -> None:
    eye = torch.tensor([0.0, 0.0, 200.0 if size[1] > 100 else 20.0])
    pose = look_at(eye, torch.tensor(target), torch.tensor([0.0, 1.0, 0.0]))
    assert sees_box(Camera(pose, size, 0.1), GRID) is expected


def inverse(pose: Tensor) -> Tensor:
    return torch.linalg.inv(torch.cat([pose, pose.new_tensor([[0, 0, 0, 1]])]))[:3]


def as_opencv(pose: Tensor) -> Tensor:
    return pose * torch.tensor([1.0, -1, -1, 1])


def turned(sign: int) -> Callable[[Tensor], Tensor]:
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
def test_the_mistake_is_named_that_blinds_all_cameras(
    mistake: Callable[[Tensor], Tensor], words: str
) -> None:
    grid = Grid.from_xyz((1, 1, 1), (9, 8, 7), (11, 12, 13))
    center = torch.tensor(grid.center_xyz, dtype=torch.float64)
    eyes = torch.tensor([[9.0, 1, 20], [-8, 3, 19], [18, -4, 6]], dtype=torch.float64)
    seeing = [Camera(look_at(center + eye, center, UP), (9, 9), 0.1) for eye in eyes]
    assert all(sees_box(camera, grid) for camera in seeing)
    blind = [replace(camera, pose=mistake(camera.pose)) for camera in seeing]
    assert not any(sees_box(camera, grid) for camera in blind)
    assert words in explain_blindness(blind, blind, grid)


def test_cameras_that_see_the_box_by_chance_are_asked_as_well() -> None:
    """World to camera read as camera to world: some of many look at the box all the same."""
    middle = torch.tensor(GRID.center_xyz, dtype=torch.float64)
    turns = [0.4 + 0.8 * index for index in range(7)]
    eyes = [torch.tensor([math.cos(a), 0.4, math.sin(a)]) for a in turns]
    poses = [look_at(middle + 9 * eye.double(), middle, UP) for eye in eyes]
    cameras = [Camera(inverse(as_opencv(pose)), (9, 12), 0.3) for pose in poses]
    blind = [camera for camera in cameras if not sees_box(camera, GRID)]
    assert 0 < len(blind) < len(cameras)
    assert "world to camera with OpenCV axes" in explain_blindness(blind, cameras, GRID)
