"""A calibration errs in its own way: in directions, and in places."""

import math

import pytest
import torch

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.reconstruct.numbers import calibration_prior
from ddrecon.reconstruct.tuning import SHIFT, TURN

GRID = Grid((4, 6, 5), (-1.0, -1.0, -1.0), (1.0, 2.0, 1.0))


def test_a_camera_turned_in_its_place_errs_in_direction_only() -> None:
    place = torch.tensor([2.0, 1.0, 3.0], dtype=torch.float64)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    camera = Camera(look_at(place, torch.zeros(3).double(), up), (8, 8), 0.3)
    prior = calibration_prior(camera, GRID)
    away = camera.pose[:, :3].T @ (place - torch.tensor(GRID.center_xyz).double())
    turn = torch.tensor([0.01, -0.02, 0.005], dtype=torch.float64)
    in_place = torch.cat([turn, -torch.linalg.cross(turn, away)])
    assert float(in_place @ prior @ in_place) == pytest.approx(float(turn.square().sum()) / TURN**2)
    # and one that is moved errs in place only
    shift = torch.cat([torch.zeros(3).double(), turn])
    wanted = float(turn.square().sum()) / (SHIFT * float(away.norm())) ** 2
    assert float(shift @ prior @ shift) == pytest.approx(wanted)


def test_parallel_rays_come_from_no_place() -> None:
    pose = look_at(*torch.tensor([[0.0, 0, 5], [0, 0, 0], [0, 1, 0]], dtype=torch.float64))
    priors = []
    for distance in (5.0, 50.0):
        moved = pose.clone()
        moved[2, 3] = distance
        priors.append(calibration_prior(Camera(moved, (8, 8), 1.0, False), GRID))
    torch.testing.assert_close(*priors)
    assert math.isfinite(float(priors[0].sum()))
