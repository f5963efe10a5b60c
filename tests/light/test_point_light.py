"""Point lights: the inverse square law, limits of parallel light, and the light itself."""

import math
from dataclasses import replace

import pytest
import torch
from media import box_grid, convergence_order, half_empty, make_camera, make_scene, tensor
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight, PointLight
from ddrecon.light.moments import flux_along_axes
from ddrecon.light.point_light import follow_point_light, receive_point_light
from ddrecon.medium.coefficients import Medium, Volume, scale_medium
from ddrecon.picture import render

SHAPE = (5, 4, 6)
OUTSIDE, INSIDE = (0.3, 1.7, 1.1), (0.11, 0.13, 0.17)


def light_at(position: tuple[float, ...]) -> PointLight:
    return PointLight(tensor(*position), tensor(2.0))


def medium_of(grid: Grid, density: Tensor, g: float = 0.4) -> Medium:
    return scale_medium(Volume(grid, density, tensor(0.5), tensor(3.0), tensor(g)[0]))


def offsets(grid: Grid, position: tuple[float, ...]) -> Tensor:
    """From the light to the cell centers, `[z, y, x, 3]` in array order."""
    axes = torch.broadcast_tensors(*grid.centers(tensor(0)))
    return torch.stack(axes, -1) - tensor(*position[::-1])


def cell_center(grid: Grid, *cell: int) -> tuple[float, ...]:
    """The center (x, y, z) of a cell (z, y, x)."""
    return tuple(offsets(grid, (0.0, 0.0, 0.0))[cell].flip(0).tolist())


@pytest.mark.parametrize("position", [OUTSIDE, INSIDE], ids=["outside", "inside"])
def test_without_a_medium_light_falls_with_the_square_of_the_distance(position: tuple[float, ...]):
    """Everywhere but in the light's own cell."""
    grid = box_grid((10, 12, 9))
    empty = medium_of(grid, torch.zeros(grid.shape, dtype=torch.float64))
    received, offset = receive_point_light(empty, light_at(position), 1), offsets(grid, position)
    distance = offset.norm(dim=-1)
    is_apart = distance > max(grid.spacing)
    expected = 2.0 / (4 * math.pi) / distance**2
    torch.testing.assert_close(received[0, 0][is_apart], expected[is_apart], rtol=1e-13, atol=0)
    flux, expected = (
        torch.stack(flux_along_axes(received[1:]), -1)[0],
        3 * (expected / distance)[..., None],
    )
    expected = (expected * offset)[is_apart]
    torch.testing.assert_close(flux[is_apart], expected, rtol=1e-12, atol=1e-16)


@pytest.mark.parametrize("position", [OUTSIDE, INSIDE, (0.0, 3.0, 0.0)], ids=str)
def test_in_a_homogeneous_box_depth_is_path_length(position: tuple[float, ...]):
    grid = box_grid((7, 6, 5))
    even = medium_of(grid, torch.ones(grid.shape, dtype=torch.float64))
    beam = follow_point_light(even, light_at(position))
    for z, y, x in ((0, 0, 0), (6, 5, 4), (3, 1, 2), (6, 0, 1)):
        end = cell_center(grid, z, y, x)[::-1]
        start, entered = position[::-1], 0.0
        for low, high, a, b in zip(grid.lower, grid.upper, start, end, strict=True):
            if not low <= a <= high:
                entered = max(entered, ((low if a < low else high) - a) / (b - a))
        inside = (1 - entered) * math.dist(start, end)
        assert float(beam.mass[0, z, y, x]) == pytest.approx(inside, rel=1e-12)


def test_a_far_point_light_lights_a_fine_grid_as_a_directional_one():
    """The two ways to find depths agree as cells shrink."""
    errors, counts = [], [8, 16, 32]
    for count in counts:
        grid = Grid((count, count + 2, count), (-0.5, -0.6, -0.4), (0.5, 0.6, 0.5))
        density = 8 * torch.exp(-sum(axis**2 for axis in grid.centers(tensor(0))) / 0.04)
        scene, towards = make_scene(density, grid=grid, model="none"), tensor(0.6, 0.8, 0.0)
        point, sun = PointLight(1e6 * towards, tensor(3e12)), DirectionalLight(-towards, tensor(3))
        images = [render(replace(scene, lights=[light])) for light in (point, sun)]
        errors.append(float((images[0] - images[1]).norm() / images[1].norm()))
    assert errors[-1] < 1e-2, errors
    assert convergence_order([1 / count for count in counts[1:]], errors[1:]) > 1.5, errors


@pytest.mark.parametrize("where", ["center", "corner", "face", "face of the box", "eye"])
def test_a_light_on_a_cell_is_finite_with_finite_derivatives(where: str):
    camera = make_camera(eye=(0.05, 0.1, 0.15), half_width=0.8)
    scene = make_scene(half_empty(*SHAPE), g=0.4, camera=camera)
    grid = scene.volume.grid
    (z, y, x), center = grid.spacing, cell_center(grid, 2, 1, 3)
    shifts = {"center": (0, 0, 0), "corner": (x / 2, y / 2, z / 2), "face": (0, y / 2, 0)}
    position = {"face of the box": (0.1, 0.6, 0.1), "eye": (0.05, 0.1, 0.15)}.get(where)
    light = light_at(position or tuple(c + s for c, s in zip(center, shifts[where], strict=True)))
    numbers = light.position, light.intensity, scene.volume.density
    for number in numbers:
        number.requires_grad_()
    image = render(replace(scene, lights=[light]))
    assert torch.isfinite(image).all() and image.max() < 1e3
    for slope in torch.autograd.grad(image.sum(), numbers):
        assert bool(torch.isfinite(slope).all()) and float(slope.abs().max()) < 1e5


def test_a_light_in_a_cell_hands_it_the_mean_of_its_sphere():
    """3 / R^2, the mean of 1 / r^2 over a sphere of a cell's volume around the light; no flux."""
    grid = box_grid((5, 4, 6))
    empty = medium_of(grid, torch.zeros(5, 4, 6, dtype=torch.float64))
    received = receive_point_light(empty, light_at(cell_center(grid, 2, 1, 3)), 1)
    radius = (0.75 / math.pi * math.prod(grid.spacing)) ** (1 / 3)
    mean = 2.0 / (4 * math.pi) * 3 / radius**2
    assert float(received[0, 0, 2, 1, 3]) == pytest.approx(mean, rel=1e-12)
    assert float(received[1:, 0, 2, 1, 3].abs().max()) < 1e-12
