"""Rays against the volume's box."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ddrecon.cameras import Camera, Rays, look_at
from ddrecon.grid import Grid
from ddrecon.march.box import cross_box
from ddrecon.scene_file.build_views import explain_blindness, sees_box

GRID = Grid.from_xyz(
    (1, 1, 1), (-1, -2, -3), (1, 2, 3)
)  # in array order the box is (-3, -2, -1) to (3, 2, 1)


def hits(origin: tuple[float, ...], direction: tuple[float, ...]) -> bool:
    ray = Rays(torch.tensor([origin]), torch.tensor([direction]), None)
    return cross_box(GRID, ray).hit.numel() > 0


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0.0, 0.0, 9.0), (0.0, 0.0, -1.0), True),
        ((0.0, 0.0, 9.0), (0.0, 0.0, 1.0), False),
        ((2.9, 0.0, 9.0), (0.0, 0.0, -1.0), True),
        ((3.1, 0.0, 9.0), (0.0, 0.0, -1.0), False),
        ((0.0, 2.1, 9.0), (0.0, 0.0, -1.0), False),
        ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), True),
        ((0.0, -9.0, 2.0), (0.0, 1.0, 0.0), False),
    ],
)
def test_axis_parallel_rays(
    origin: tuple[float, ...], direction: tuple[float, ...], expected: bool
):
    assert hits(origin, direction) is expected


POINT = st.tuples(*[st.floats(-6, 6, width=32)] * 3)


@given(
    origin=POINT, inside=st.tuples(st.floats(-2.9, 2.9), st.floats(-1.9, 1.9), st.floats(-0.9, 0.9))
)
def test_a_ray_towards_an_inner_point_hits(origin: tuple[float, ...], inside: tuple[float, ...]):
    direction = torch.tensor(inside) - torch.tensor(origin)
    if direction.norm() > 0.1:
        assert hits(origin, tuple((direction / direction.norm()).tolist()))


@given(origin=POINT, direction=POINT)
def test_marching_along_the_ray_agrees(origin: tuple[float, ...], direction: tuple[float, ...]):
    length = torch.tensor(direction).norm()
    if length > 0.1:
        unit = torch.tensor(direction) / length
        points = torch.tensor(origin) + torch.linspace(0, 20, 2001)[:, None] * unit
        if bool((points.abs() < torch.tensor([2.99, 1.99, 0.99])).all(dim=1).any()):
            assert hits(origin, tuple(unit.tolist()))


@pytest.mark.parametrize(
    ("target", "expected"),
    [((0.0, 0.0, 0.0), True), ((0.0, 0.0, 90.0), False), ((40.0, 0.0, 0.0), False)],
)
@pytest.mark.parametrize("size", [(1, 1), (33, 17)])
def test_cameras(target: tuple[float, ...], expected: bool, size: tuple[int, int]):
    pose = look_at(
        torch.tensor([0.0, 0.0, 20.0]), torch.tensor(target), torch.tensor([0.0, 1.0, 0.0])
    )
    assert sees_box(Camera(pose, size, 0.1), GRID) is expected


def test_one_pixel_suffices():
    pose = look_at(
        torch.tensor([0.0, 0.0, 1000.0]),
        torch.tensor([100.0, 0.0, 0.0]),
        torch.tensor([0.0, 1.0, 0.0]),
    )
    assert sees_box(Camera(pose, (1, 501), 0.15), GRID)


def seeing_cameras() -> list[Camera]:
    origins = ([9.0, 1.0, 20.0], [-8.0, 3.0, 19.0], [18.0, -4.0, 6.0])
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    return [
        Camera(
            look_at(torch.tensor(eye, dtype=torch.float64), torch.zeros_like(up), up), (9, 9), 0.2
        )
        for eye in origins
    ]


def as_opencv(pose: torch.Tensor) -> torch.Tensor:
    return pose * torch.tensor([1.0, -1, -1, 1])


def inverse(pose: torch.Tensor) -> torch.Tensor:
    whole = torch.eye(4, dtype=pose.dtype)
    whole[:3] = pose
    return torch.linalg.inv(whole)[:3]


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (as_opencv, "OpenCV axes (right, down, forward): negate"),
        (inverse, "world to camera: give the inverse"),
        (lambda pose: inverse(as_opencv(pose)), "world to camera with OpenCV axes"),
        (lambda pose: pose + 50 * torch.eye(3, 4)[:, [3, 3, 3, 0]], "the cameras look at about"),
    ],
)
def test_the_mistake_is_named_that_blinds_all_cameras(
    mistake: Callable[[torch.Tensor], torch.Tensor], words: str
) -> None:
    seeing = seeing_cameras()
    assert all(sees_box(camera, GRID) for camera in seeing)
    blind = [replace(camera, pose=mistake(camera.pose)) for camera in seeing]
    assert words in explain_blindness(blind, GRID)


@pytest.mark.parametrize("is_y_up", [True, False])
def test_the_other_axis_that_is_up_is_named(is_y_up: bool) -> None:
    """The world turned by 90 degrees about x takes the box's place above or beside the origin."""
    box = ((-1, -2, 9), (1, 2, 12)) if is_y_up else ((-1, 9, -2), (1, 12, 2))
    grid = Grid.from_xyz((1, 1, 1), *box)
    center = torch.tensor(grid.center_xyz, dtype=torch.float64)
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    cameras = []
    for eye in ([20.0, 3.0, 3.0], [-15.0, 9.0, 9.0]):
        up = torch.tensor([0.0, 0.0, 1.0] if is_y_up else [0.0, 1.0, 0.0], dtype=torch.float64)
        pose = look_at(center + torch.tensor(eye, dtype=torch.float64), center, up)
        cameras.append(Camera((turn.T if is_y_up else turn) @ pose, (9, 9), 0.05))
    words = "y up in a scene with z up" if is_y_up else "z up, as in Blender, in a scene with y up"
    assert words in explain_blindness(cameras, grid)


def test_cameras_that_see_the_box_by_chance_are_asked_as_well() -> None:
    """World to camera read as camera to world: some of many look at the box all the same."""
    up, middle = torch.tensor([0.0, 1.0, 0.0]), torch.tensor(GRID.center_xyz)
    poses = [
        look_at(middle + 9 * torch.tensor([math.cos(a), 0.4, math.sin(a)]), middle, up)
        for a in (0.4 + 0.8 * i for i in range(7))
    ]
    cameras = [Camera(inverse(as_opencv(pose)), (9, 12), 0.3) for pose in poses]
    seeing = [camera for camera in cameras if sees_box(camera, GRID)]
    blind = [camera for camera in cameras if not sees_box(camera, GRID)]
    assert seeing and blind
    assert "world to camera with OpenCV axes" in explain_blindness(blind, GRID, seeing)
