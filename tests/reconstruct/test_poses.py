"""Poses: the curvature is the derivative of the gradient, and a calibration errs in its own way."""

import math
from pathlib import Path

import pytest
import torch

from ddrecon.cameras import Camera, look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.losses import Target
from ddrecon.reconstruct.poses import SHIFT, TURN, calibration_prior, pose_curvature
from ddrecon.renderer import solve_light, view_picture
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import with_values

CONFIG = Path(__file__).parents[2] / "configs" / "gradcheck_all.yaml"
GRID = Grid((4, 6, 5), (-1.0, -1.0, -1.0), (1.0, 2.0, 1.0))


@pytest.mark.parametrize("loss", ["l2", "display", "photon"])
def test_where_a_picture_fits_the_curvature_is_the_derivative_of_the_gradient(loss: str) -> None:
    small = ["volume.resolution=[5, 4, 3]", "volume.density=0.7", "render.tolerance=0"]
    small += ["views.0.exposure=0.1", "views.0.background=0.05"]  # nothing as bright as white
    scene, name = load_scene(CONFIG, overrides=small, dtype=torch.float64), "views.front.camera"
    with torch.no_grad():
        field = solve_light(scene, SolveMemory())
        target = Target.of(view_picture(field, scene, scene.view("front")), None, loss)
    curvature = pose_curvature(field, scene, name, target)
    torch.testing.assert_close(curvature, curvature.T)

    def gradient(change: torch.Tensor) -> torch.Tensor:
        change = change.clone().requires_grad_()
        moved = with_values(scene, {name: change})
        loss = target.loss_of(view_picture(field, moved, moved.view("front")))
        return torch.autograd.grad(loss, change)[0]

    way = 1e-5 * torch.tensor([1.0, -0.5, 0.7, 0.3, 0.6, -0.4], dtype=torch.float64)
    difference = (gradient(way) - gradient(-way)) / 2
    torch.testing.assert_close(difference, curvature @ way, rtol=1e-3, atol=0)


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
