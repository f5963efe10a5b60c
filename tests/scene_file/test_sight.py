"""Rays against the volume's box."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ddrecon.cameras import Camera, Rays, look_at
from ddrecon.grid import Grid
from ddrecon.march.box import cross_box
from ddrecon.scene_file.sight import explain_blindness, sees_box

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


def given_as(pose: torch.Tensor, is_inverse: bool, is_opencv: bool) -> torch.Tensor:
    """The camera to world matrix `pose` [3, 4], with OpenGL axes, in another convention."""
    matrix = torch.cat([pose, torch.tensor([[0.0, 0, 0, 1]])])
    matrix = matrix @ torch.diag(torch.tensor([1.0, -1, -1, 1])) if is_opencv else matrix
    return (torch.linalg.inv(matrix) if is_inverse else matrix)[:3]


@pytest.mark.parametrize(
    ("is_inverse", "is_opencv", "words"),
    [
        (False, True, "in OpenCV's axes (y down, z forward), ours in OpenGL's: negate"),
        (True, False, "world to camera, ours camera to world: invert each"),
        (True, True, "world to camera in OpenCV's axes, as COLMAP has them"),
    ],
)
@pytest.mark.parametrize("count", [1, 7])
def test_the_convention_of_matrices_is_found(
    is_inverse: bool, is_opencv: bool, words: str, count: int
) -> None:
    """Also where some happen to see the box as they stand."""
    middle, up = torch.tensor([0.3, 0.1, -0.2]), torch.tensor([0.0, 1.0, 0.0])
    angles = torch.linspace(0.4, 6, 7)[:count]
    poses = [
        look_at(middle + 9 * torch.tensor([float(a.cos()), 0.4, float(a.sin())]), middle, up)
        for a in angles
    ]
    cameras = [Camera(given_as(pose, is_inverse, is_opencv), (9, 12), 0.3) for pose in poses]
    blind = [camera for camera in cameras if not sees_box(camera, GRID)]
    seeing = [camera for camera in cameras if sees_box(camera, GRID)]
    assert blind and explain_blindness(blind, seeing, GRID).startswith(f"the matrices are {words}")


def test_no_cure_is_made_up() -> None:
    """Where the box is elsewhere, as with bounds in another unit, no convention helps."""
    up = torch.tensor([0.0, 1.0, 0.0])
    poses = [
        look_at(torch.tensor([x, 0.0, 90.0]), torch.tensor([x, 0.0, 0.0]), up) for x in (50, 70)
    ]
    line = explain_blindness([Camera(pose, (9, 12), 0.1) for pose in poses], [], GRID)
    assert "check volume.bounds" in line and "looked past" in line
