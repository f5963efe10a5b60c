"""Gaussian beams: their power, their limits, and how view rays see them."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import box_grid, make_camera, make_scene, random_values, tensor
from torch import Tensor

from ddrecon.light.lights import BeamLight, DirectionalLight
from ddrecon.light.profile import profile_in
from ddrecon.lighting import fluence
from ddrecon.picture import render
from ddrecon.settings import RenderSettings

AXES = (0.0, 0.0, -1.0), (0.3, -1.0, 0.2), (0.5, 0.4, 1.3)


def length_in_box(direction: Tensor) -> float:
    """Of the line along `direction` (x, y, z) through the middle of a box 0.9 x 1.2 x 1."""
    half = tensor(0.45, 0.6, 0.5)
    return 2 * float((half / (direction / direction.norm()).abs()).min())


@pytest.mark.parametrize("radius", [0.0, 0.03, 0.1])
@pytest.mark.parametrize("axis", AXES)
def test_cells_together_receive_the_power_of_a_beam(axis: tuple[float, ...], radius: float) -> None:
    """In an empty box, power times way; along z wherever in its cell the axis runs."""
    grid, direction = box_grid((16, 20, 18)), tensor(*axis)
    for shift in (0.0, 0.013, 0.03) if axis == AXES[0] else (0.0,):
        place = tensor(0.05 + shift, -0.7 * shift, 3.0 * shift) - 3 * direction
        profile = profile_in(grid, place, direction, tensor(radius)[0])
        way = float(profile.sum()) * math.prod(grid.spacing)
        assert way == pytest.approx(length_in_box(direction), rel=1e-5)


@pytest.mark.parametrize("axis", AXES)
def test_a_profile_is_the_mean_of_the_gaussian_over_each_cell(axis: tuple[float, ...]) -> None:
    grid, direction, radius = box_grid((4, 5, 6)), tensor(*axis), 0.4
    place = tensor(0.1, -0.05, 0.02)
    found = profile_in(grid, place, direction, tensor(radius)[0])[0]
    fine = box_grid((40, 50, 60))
    z, y, x = torch.broadcast_tensors(*fine.centers(found))
    offset = torch.stack([x, y, z], -1) - place
    travel = direction / direction.norm()
    square = offset.square().sum(-1) - (offset @ travel) ** 2
    exact = 2 / (math.pi * radius**2) * torch.exp(-2 * square / radius**2)
    mean = torch.nn.functional.avg_pool3d(exact[None, None], 10)[0, 0]
    torch.testing.assert_close(found, mean, rtol=0, atol=1e-2 * float(mean.max()))


@pytest.mark.parametrize(
    "changes", [{}, {"g": 0.8, "transport_rounds": 1}, {"model": "none"}], ids=str
)
def test_a_very_wide_beam_is_a_directional_light(changes: dict[str, Any]) -> None:
    direction, radius, irradiance = tensor(-0.4, -1.0, 0.3), 1e4, tensor(3.0, 2.0, 1.0)
    power = irradiance * math.pi * radius**2 / 2
    beam = BeamLight(tensor(0.0, 2.0, 0.0), direction, power, tensor(radius)[0])
    scene = make_scene(random_values(4, 5, 6), **changes)
    wide, sun = (
        replace(scene, lights=[light]) for light in (beam, DirectionalLight(direction, irradiance))
    )
    torch.testing.assert_close(fluence(wide), fluence(sun), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(render(wide), render(sun), rtol=1e-6, atol=1e-9)


def test_view_rays_see_what_a_thin_beam_scatters() -> None:
    """In thin air, from the side: power times cross section in all; three pixels to a cell."""
    density = torch.full((16, 18, 20), 1e-4, dtype=torch.float64)
    beam = BeamLight(tensor(0.02, 2.0, 0.07), tensor(0.0, -1.0, 0.0), tensor(2.0), tensor(0.0)[0])
    camera = make_camera((0.0, 0.0, 3.0), (120, 120), 0.9, is_perspective=False)
    scene = make_scene(density, sigma_a=(0.0,), sigma_s=(5.0,), model="none", camera=camera)
    image = render(replace(scene, lights=[beam], render=RenderSettings(tolerance=0)))[0, 0]
    pixel = (2 * 0.9 / 120) ** 2
    expected = 2.0 * 5e-4 * 1.2 / (4 * math.pi)
    assert float(image.sum()) * pixel == pytest.approx(expected, rel=2e-3)
