"""What was changed is found again: scenes rendered by this program, started from wrong values of
one kind or of all. By diffusion alone: the loop is tried here, not the rounds.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ddrecon.cameras import Camera, look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.grid import Grid
from ddrecon.light.lights import AmbientLight, DirectionalLight
from ddrecon.medium.coefficients import Volume
from ddrecon.reconstruct.loop import optimize
from ddrecon.renderer import render_each
from ddrecon.scene import Scene, View
from ddrecon.settings import DiffusionSettings, OptimizeSettings, ParameterSettings
from ddrecon.variables.values import value_of, with_values

pytestmark = pytest.mark.slow

BLOBS = (
    (0.0, 0.0, 0.0, 0.3),
    (0.15, 0.1, 0.05, 0.2),
    (-0.2, -0.05, 0.1, 0.18),
    (0.0, 0.15, -0.15, 0.2),
)


def cloud(cells: int) -> Volume:
    """A cloud of four soft blobs, lopsided, with empty space around it."""
    grid = Grid((cells, cells, cells), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    z, y, x = grid.centers(torch.zeros(1))
    density = torch.zeros(grid.shape)
    for cx, cy, cz, radius in BLOBS:
        distance = ((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2).sqrt()
        density = torch.maximum(density, torch.sigmoid(25 * (radius - distance)))
    density = torch.where(density > 0.02, density, 0)
    return Volume(
        grid,
        density,
        torch.tensor([0.5, 1.0, 2.0]),
        torch.tensor([12.0, 10.0, 8.0]),
        torch.tensor(0.2),
    )


def camera(turn: float, height: float, pixels: int) -> Camera:
    eye = torch.tensor([2.5 * math.sin(turn), height, 2.5 * math.cos(turn)])
    return Camera(
        look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])), (pixels, pixels), 0.27
    )


def scene_of(volume: Volume, views: int, pixels: int) -> Scene:
    lights = [
        DirectionalLight(torch.tensor([-1.0, -2.0, -1.0]), torch.tensor([3.0, 2.5, 2.0])),
        AmbientLight(torch.tensor([0.1, 0.12, 0.15])),
    ]
    cameras = [
        camera(2 * math.pi * index / views, 0.5 * (-1) ** index, pixels) for index in range(views)
    ]
    seen = [View(f"view_{index}", item) for index, item in enumerate(cameras)]
    return Scene(
        volume, lights, seen, diffusion=DiffusionSettings(tolerance=1e-5, transport_rounds=0)
    )


def photographed(scene: Scene) -> Scene:
    """`scene` with its own pictures as targets."""
    with torch.no_grad():
        images = render_each(scene, scene.views, SolveMemory())
    return replace(
        scene,
        views=[replace(view, image=image) for view, image in zip(scene.views, images, strict=True)],
    )


def recovered(
    scene: Scene, starts: dict[str, Tensor], iterations: int, **settings: ParameterSettings
) -> Scene:
    """What the loop makes of `scene` from `starts`, at one resolution, with default settings unless
    given.
    """
    parameters = {name: settings.get(name, ParameterSettings()) for name in starts}
    wanted = OptimizeSettings(parameters, iterations, refine_at=())
    return optimize(replace(scene, starts=starts, optimize=wanted)).scene


def image_error(scene: Scene, truth: Scene) -> float:
    with torch.no_grad():
        found, wanted = (
            torch.stack(render_each(item, item.views, SolveMemory())) for item in (scene, truth)
        )
    return float((found - wanted).norm() / wanted.norm())


def degrees_between(one: Tensor, other: Tensor) -> float:
    return math.degrees(math.acos(min(1.0, float(one @ other / one.norm() / other.norm()))))


def test_the_colors_of_two_lights() -> None:
    scene = photographed(scene_of(cloud(12), 3, 16))
    starts = {"lights.0.irradiance": torch.ones(3), "lights.1.radiance": torch.full((3,), 0.3)}
    found = recovered(scene, starts, 48)
    for name in starts:
        assert float((value_of(found, name) / value_of(scene, name) - 1).abs().max()) < 1e-3


def test_the_direction_of_a_light() -> None:
    scene = photographed(scene_of(cloud(12), 3, 16))
    start, truth = torch.tensor([1.0, -2.0, -1.0]), value_of(scene, "lights.0.direction")
    found = value_of(recovered(scene, {"lights.0.direction": start}, 80), "lights.0.direction")
    assert degrees_between(start, truth) > 45 and degrees_between(found, truth) < 0.5


def test_a_phase_function_that_scatters_backward() -> None:
    """The paper's cloud: started at 0.67, the truth being -0.802 (it found -0.813).

    By diffusion alone, as the paper's. With a transport round there is another minimum, at 0.71:
    two moments in angle do not describe such scattering.
    """
    volume = replace(
        cloud(12),
        sigma_a=torch.full((3,), 0.1),
        sigma_s=torch.full((3,), 40.0),
        g=torch.tensor(-0.802),
    )
    scene = photographed(scene_of(volume, 3, 16))
    assert (
        abs(float(value_of(recovered(scene, {"g": torch.tensor(0.67)}, 140), "g")) + 0.802) < 0.02
    )


@pytest.mark.parametrize("is_perspective", [True, False])
def test_a_camera_turned_by_three_degrees_where_it_stands(is_perspective: bool) -> None:
    scene = scene_of(cloud(12), 1, 24)
    (view,) = scene.views
    view.camera.is_perspective, view.camera.half_width = (
        is_perspective,
        0.27 if is_perspective else 0.6,
    )
    scene = photographed(scene)
    pose = view.camera.pose
    axis = torch.tensor([1.0, 0.5, 0.7])
    x, y, z = axis / axis.norm() * math.radians(3)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    turned = replace(view.camera, pose=torch.cat([pose[:, :3] @ turn, pose[:, 3:]], 1))
    start = replace(scene, views=[replace(scene.views[0], camera=turned)])
    found = recovered(start, {"views.view_0.camera": torch.zeros(6)}, 250).views[0].camera.pose
    backward = [item[:, 2] for item in (turned.pose, found, pose)]
    assert degrees_between(backward[0], backward[2]) > 2
    assert all(degrees_between(found[:, axis], pose[:, axis]) < 0.1 for axis in range(3))


def colored(volume: Volume) -> dict[str, Tensor]:
    """Absorption and scattering that differ from place to place and color to color."""
    z, y, x = volume.grid.centers(torch.zeros(1))
    sigma_a = [1 + 0.5 * torch.sin(4 * x + 3 * y + color) * torch.cos(3 * z) for color in range(3)]
    sigma_s = [12 + 4 * torch.cos(5 * y + color) * torch.cos(4 * z - x) for color in range(3)]
    return {"sigma_a": torch.stack(sigma_a), "sigma_s": torch.stack(sigma_s)}


def test_absorption_and_scattering_fields_of_a_cloud_of_known_density() -> None:
    scene = scene_of(cloud(12), 6, 16)
    truth = colored(scene.volume)
    scene = photographed(with_values(scene, truth))
    starts = {name: torch.full_like(field, float(field.mean())) for name, field in truth.items()}
    settings = {
        "sigma_a": ParameterSettings(lr=0.1, tv=1e-4),
        "sigma_s": ParameterSettings(lr=1.0, tv=1e-5),
    }
    found = recovered(scene, starts, 50, **settings)
    amount = scene.volume.density
    for name, field in truth.items():
        error, start = (
            float(((value - field).abs() * amount).sum() / (field * amount).sum())
            for value in (value_of(found, name), starts[name])
        )
        assert start > 0.15 and error < 0.75 * start, name


def test_everything_jointly_renders_as_the_truth() -> None:
    truth = photographed(scene_of(cloud(12), 3, 12))
    off = {
        "density": 0.5 * truth.volume.density + 0.1,
        "sigma_a": torch.ones(3),
        "sigma_s": torch.full((3,), 8.0),
        "g": torch.tensor(0.0),
        "lights.0.irradiance": torch.full((3,), 2.0),
        "lights.0.direction": torch.tensor([-1.2, -2.0, -0.6]),
        "lights.1.radiance": torch.full((3,), 0.2),
        "views.view_1.camera": torch.zeros(6),
    }
    shift = torch.tensor([0.03, -0.03, 0.02, 0.02, 0.03, 0.1])
    moved = with_values(truth, {"views.view_1.camera": shift})
    found = recovered(moved, off, 80, density=ParameterSettings(tv=0.0))
    assert image_error(with_values(moved, off), truth) > 0.5
    assert image_error(found, truth) < 0.03
