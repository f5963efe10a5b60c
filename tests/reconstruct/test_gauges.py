"""Gauges: what no picture shows is not changed; and how a calibration errs."""

import math
from dataclasses import replace

import pytest
import torch

from ddrecon.cameras import Camera, look_at, twist
from ddrecon.grid import Grid
from ddrecon.reconstruct.metric import Numbers, calibration_prior
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.tuning import SHIFT, TURN
from ddrecon.settings import ParameterSettings


def parameters(scene, key, values):
    names = [f"views.{view.name}.{key}" for view in scene.views]
    return [
        Parameter(name, ParameterSettings(), value, scene.volume.grid)
        for name, value in zip(names, values, strict=True)
    ]


@pytest.fixture
def world(ball_scene):
    views = [
        replace(view, camera=replace(view.camera, pose=view.camera.pose.double()))
        for view in ball_scene.views
        if not view.is_test
    ]
    return replace(ball_scene, views=views[:4])


def test_the_mean_exposure_is_held_by_color(world):
    start = torch.ones(len(world.views), 3).double()
    exposures = parameters(world, "exposure", list(start))
    (gauge,) = Numbers(world, exposures).gauges
    moved = 1 + torch.rand(start.shape, dtype=torch.float64)
    held = moved.flatten()
    gauge.hold(held)
    held = held.view_as(moved)
    torch.testing.assert_close(held.log().mean(0), torch.zeros(3).double())
    torch.testing.assert_close((held / moved).log().std(0), torch.zeros(3).double())


def test_one_view_alone_and_some_of_several_have_no_gauge(world):
    exposures = parameters(world, "exposure", [torch.ones(1)] * len(world.views))
    assert Numbers(world, exposures[1:]).gauges == []
    assert Numbers(replace(world, views=world.views[:1]), exposures[:1]).gauges == []


def test_a_motion_of_all_cameras_together_is_taken_out(world):
    """The cameras are turned and moved as one rigid body, and nothing of it is left."""
    center, turn, shift = world.volume.grid.center_xyz, [0.02, -0.01, 0.03], [0.1, 0.2, -0.1]
    common = []
    for view in world.views:
        inverse = view.camera.pose[:, :3].T
        common.append(torch.cat([inverse @ torch.tensor(v).double() for v in (turn, shift)]))
    moved = [twist(v.camera, c, center).pose for v, c in zip(world.views, common, strict=True)]
    for one, other in ((0, 1), (0, 2)):
        before, after = (
            poses[one][:, :3].T @ (poses[other][:, 3] - poses[one][:, 3])
            for poses in ([view.camera.pose for view in world.views], moved)
        )
        torch.testing.assert_close(before, after)
    cameras = parameters(world, "camera", [torch.zeros(6).double()] * len(world.views))
    (gauge,) = Numbers(world, cameras).gauges
    own = [1e-3 * torch.rand(6, dtype=torch.float64) for _ in cameras]
    results = []
    for extra in (1.0, 0.0):
        twists = torch.cat([extra * a + b for a, b in zip(common, own, strict=True)])
        gauge.hold(twists)
        results.append(twists)
    torch.testing.assert_close(*results)
    assert results[0].norm() > 1e-4


GRID = Grid((4, 6, 5), (-1.0, -1.0, -1.0), (1.0, 2.0, 1.0))


def test_a_camera_turned_in_its_place_errs_in_direction_only():
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


def test_parallel_rays_come_from_no_place():
    pose = look_at(*torch.tensor([[0.0, 0, 5], [0, 0, 0], [0, 1, 0]], dtype=torch.float64))
    priors = []
    for distance in (5.0, 50.0):
        moved = pose.clone()
        moved[2, 3] = distance
        priors.append(calibration_prior(Camera(moved, (8, 8), 1.0, False), GRID))
    torch.testing.assert_close(*priors)
    assert math.isfinite(float(priors[0].sum()))
