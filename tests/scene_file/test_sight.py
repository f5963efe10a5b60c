"""Rays against the volume's box."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ddrecon.cameras import Camera, Rays, look_at
from ddrecon.grid import Grid
from ddrecon.march.box import cross_box
from ddrecon.scene_file.sight import sees_box

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
