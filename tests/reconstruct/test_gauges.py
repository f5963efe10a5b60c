"""Gauges: what no picture shows is not changed."""

from dataclasses import replace

import pytest
import torch

from ddrecon.cameras import twist
from ddrecon.reconstruct.numbers import find_gauges
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import Scene
from ddrecon.settings import ParameterSettings


def parameters(scene: Scene, key: str, values: list[torch.Tensor]) -> list[Parameter]:
    names = [f"views.{view.name}.{key}" for view in scene.views]
    return [
        Parameter(name, ParameterSettings(), 0.1, value, scene.volume.grid)
        for name, value in zip(names, values, strict=True)
    ]


@pytest.fixture
def world(ball_scene: Scene) -> Scene:
    views = [
        replace(view, camera=replace(view.camera, pose=view.camera.pose.double()))
        for view in ball_scene.views
        if not view.is_test
    ]
    return replace(ball_scene, views=views[:4])


def test_the_mean_exposure_is_held_by_color(world: Scene) -> None:
    start = torch.ones(len(world.views), 3).double()
    exposures = parameters(world, "exposure", list(start))
    (gauge,) = find_gauges(world, exposures)
    moved = 1 + torch.rand(start.shape, dtype=torch.float64)
    for parameter, value in zip(exposures, moved, strict=True):
        parameter.value = value
    gauge.hold()
    held = torch.stack([parameter.value.detach() for parameter in exposures])
    torch.testing.assert_close(held.log().mean(0), torch.zeros(3).double())
    torch.testing.assert_close((held / moved).log().std(0), torch.zeros(3).double())


def test_one_view_alone_and_some_of_several_have_no_gauge(world: Scene) -> None:
    exposures = parameters(world, "exposure", [torch.ones(1)] * len(world.views))
    assert find_gauges(world, exposures[1:]) == []
    assert find_gauges(replace(world, views=world.views[:1]), exposures[:1]) == []


def test_a_motion_of_all_cameras_together_is_taken_out(world: Scene) -> None:
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
    (gauge,) = find_gauges(world, cameras)
    own = [1e-3 * torch.rand(6, dtype=torch.float64) for _ in cameras]
    results = []
    for extra in (1.0, 0.0):
        for parameter, a, b in zip(cameras, common, own, strict=True):
            parameter.value = extra * a + b
        gauge.hold()
        results.append(torch.stack([parameter.value.detach() for parameter in cameras]))
    torch.testing.assert_close(*results)
    assert results[0].norm() > 1e-4
