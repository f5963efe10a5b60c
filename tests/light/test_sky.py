"""What an environment map sheds: power, first moment, suns; agreement with simpler lights."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from media import half_empty, light_of, make_scene, random_values, tensor
from torch import Tensor

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.light.environment import pixel_moments
from ddrecon.light.lights import DirectionalLight, EnvironmentLight
from ddrecon.light.reduced import sum_unscattered_sky
from ddrecon.light.sky import MAX_SUNS, count_suns, decompose_map, fibonacci_sphere
from ddrecon.medium.coefficients import scale_medium
from ddrecon.picture import render
from ddrecon.scene import Scene

SHAPE = (5, 4, 6)


def uneven(height: int, width: int, seed: int = 0) -> Tensor:
    """A map [3, h, w] with one small bright spot in it, which is a sun."""
    radiance = random_values(3, height, width, seed=seed)
    radiance[:, height // 3, width // 5] += 3 * height * width
    return radiance


def banded(height: int, width: int) -> Tensor:
    """A map [3, h, w] without suns, bright on one side and dark on the other."""
    around = (torch.arange(width, dtype=torch.float64) + 0.5) * (2 * math.pi / width)
    return (1 + torch.sin(around)).expand(3, height, width) + uneven(height, width).clamp(max=1)


def hot_pixel(
    height: int, width: int, row: int, column: int
) -> tuple[EnvironmentLight, DirectionalLight]:
    """A map black but for one pixel, and the parallel light it is, by its solid angle."""
    radiance = torch.zeros(3, height, width, dtype=torch.float64)
    radiance[:, row, column] = torch.tensor([300.0, 200.0, 100.0])
    down, around = math.pi * row / (height - 1), 2 * math.pi * (column + 0.5) / width
    solid_angle = math.sin(down) * math.pi / (height - 1) * 2 * math.pi / width
    x, y, z = math.sin(down) * math.sin(around), math.cos(down), -math.sin(down) * math.cos(around)
    sun = DirectionalLight(tensor(-x, -y, -z), radiance[:, row, column] * solid_angle)
    return light_of(radiance), sun


def relative_error(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).norm() / expected.norm())


@pytest.mark.parametrize("count", [1, 7, 48])
def test_directions_are_spread_evenly(count: int):
    directions = fibonacci_sphere(count)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-14)
    closest = np.sort(directions @ directions.T, axis=1)[:, -2] if count > 1 else np.array([-1.0])
    assert np.arccos(closest).min() > 0.6 * math.sqrt(4 * math.pi / count) or count == 1


@pytest.mark.parametrize("directions", [1, 6, 48])
@pytest.mark.parametrize("size", [(2, 3), (5, 8), (32, 64)], ids=str)
def test_power_and_first_moment_of_a_map_are_those_of_its_parts(
    size: tuple[int, int], directions: int
):
    """All that a map without suns sends in, and the vector along which it goes."""
    light = light_of(random_values(3, *size), scale=1.3, rotation=25.0, directions=directions)
    (ambient, sky) = decompose_map(light)
    weights = 1.3 * torch.from_numpy(pixel_moments(*size)).flatten(1)
    power, *vector = weights @ light.radiance.flatten(1).T
    known = 4 * math.pi * ambient.radiance + sky.irradiance.sum(0)
    torch.testing.assert_close(known, power, rtol=1e-12, atol=0)
    sine, cosine = math.sin(math.radians(25.0)), math.cos(math.radians(25.0))
    x, y, z = (-one for one in vector)
    expected = torch.stack([cosine * z - sine * x, y, cosine * x + sine * z])
    torch.testing.assert_close(sky.vector.sum(0), expected, rtol=1e-11, atol=1e-12)
    assert float(sky.irradiance.sum(0).abs().max()) < 1e-12


def test_with_a_sun_power_is_kept_and_the_sky_is_the_rest():
    light = light_of(uneven(16, 32))
    sun, ambient, sky = decompose_map(light)
    moments = torch.from_numpy(pixel_moments(16, 32)).flatten(1) @ light.radiance.flatten(1).T
    total = sun.irradiance + 4 * math.pi * ambient.radiance + sky.irradiance.sum(0)
    torch.testing.assert_close(total, moments[0], rtol=1e-12, atol=0)
    assert bool((ambient.radiance < 1).all()) and count_suns(light) == (1, len(sky.travel))


def test_there_are_at_most_four_suns():
    radiance = torch.zeros(1, 16, 32, dtype=torch.float64)
    radiance[0, 8, ::5] = 1 + random_values(7)
    assert count_suns(light_of(radiance))[0] == MAX_SUNS


@pytest.mark.parametrize("directions", [1, 2, 6, 48, 200])
def test_a_constant_map_is_ambient_light_whatever_the_directions(directions: int):
    color = torch.tensor([0.7, 0.2, 0.0], dtype=torch.float64)
    even = color.view(3, 1, 1).expand(3, 6, 8)
    ambient, sky = decompose_map(light_of(even, directions=directions))
    assert torch.equal(ambient.radiance, color) and not sky.irradiance.any()


@pytest.mark.parametrize("place", [(32, 64, 16, 0), (16, 32, 12, 31)], ids=str)
def test_a_hot_pixel_is_a_directional_light(place: tuple[int, int, int, int]):
    scene = make_scene(half_empty(*SHAPE), g=0.6)
    environment, directional = hot_pixel(*place)
    scene.render = replace(scene.render, background=False)
    images = [render(replace(scene, lights=[light])) for light in (environment, directional)]
    assert relative_error(*images) < 0.02


def test_a_sky_is_the_parallel_light_of_each_of_its_pixels():
    """It comes from where it is seen: bright on one side, a map without suns lights that side."""
    height, width = 12, 16
    radiance = banded(height, width).clamp(max=2)
    scene = make_scene(0.1 * half_empty(*SHAPE), g=0.6, model="none")
    lights = list[DirectionalLight]()
    for row, column in itertools.product(range(height), range(width)):
        _, sun = hot_pixel(height, width, row, column)
        pixel = tensor(300, 200, 100)
        lights.append(replace(sun, irradiance=sun.irradiance / pixel * radiance[:, row, column]))
    settings = replace(scene.render, background=False)
    scene = replace(scene, render=settings)
    sky = light_of(radiance, directions=96)
    assert count_suns(sky)[0] == 0
    images = [render(replace(scene, lights=each)) for each in ([sky], lights[width:-width])]
    assert relative_error(*images) < 0.05


def test_the_light_of_a_map_is_linear_in_scale_and_without_suns_in_radiance():
    scene = make_scene(half_empty(*SHAPE), g=0.4)
    one = random_values(3, 6, 8, seed=1)
    other = random_values(3, 6, 8, seed=2)

    def image(radiance: Tensor, scale: float) -> Tensor:
        return render(replace(scene, lights=[light_of(radiance, scale, rotation=12.0)]))

    known = 2 * image(one, 1.0) + 6 * image(other, 1.0)
    torch.testing.assert_close(image(one + 3 * other, 2.0), known, rtol=1e-9, atol=0)
    sunny = uneven(6, 8)
    torch.testing.assert_close(image(sunny, 2.5), 2.5 * image(sunny, 1.0), rtol=1e-9, atol=0)


def test_a_turned_world_looks_the_same():
    """Map, volume and camera turned by 90 degrees about +y, and so that z points up."""
    density = torch.rand(5, 4, 5, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    eye = torch.tensor([0.4, 0.5, 2.5], dtype=torch.float64)
    images = []
    for up, rotation, field, origin in (
        ("y", 0.0, density, eye),
        ("y", 90.0, density.transpose(0, 2).flip(0), eye[[2, 1, 0]] * eye.new_tensor([1, 1, -1])),
        ("z", 0.0, density.transpose(0, 1).flip(1), eye[[0, 2, 1]] * eye.new_tensor([1, -1, 1])),
    ):
        upwards = torch.eye(3, dtype=torch.float64)["xyz".index(up)]
        camera = Camera(look_at(origin, torch.zeros_like(eye), upwards), (4, 5), 0.3)
        corner = (0.5, 0.6, 0.5) if up == "y" else (0.6, 0.5, 0.5)  # z, y, x
        grid = Grid(tuple(field.shape), tuple(-side for side in corner), corner)
        scene = make_scene(field.contiguous(), grid=grid, g=0.4, camera=camera)
        light = light_of(uneven(6, 8), rotation=rotation, up=up)
        images.append(render(replace(scene, lights=[light])))
    for turned in images[1:]:
        torch.testing.assert_close(turned, images[0], rtol=1e-9, atol=0)


def test_more_directions_change_little():
    scene, radiance = make_scene(half_empty(*SHAPE), g=0.3), banded(24, 48)
    lights = (light_of(radiance, directions=count) for count in (12, 36, 108, 324))
    images = [render(replace(scene, lights=[light])) for light in lights]
    coarse, middle, fine = (relative_error(image, images[-1]) for image in images[:-1])
    assert fine < middle / 2 < coarse / 4 and middle < 2e-3


def saved_bytes(scene: Scene, directions: int) -> int:
    """Bytes that rendering keeps for its backward pass, each storage once."""
    storages: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        if tensor.device.type == "cpu":
            storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        kept.append(tensor)
        return tensor

    kept: list[Tensor] = []
    radiance = uneven(16, 32).requires_grad_()
    density = scene.volume.density.clone().requires_grad_()
    medium = scale_medium(replace(scene.volume, density=density))
    parts = decompose_map(light_of(radiance, directions=directions))
    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor):
        sum_unscattered_sky(medium, parts, degree=1)
    return sum(storages.values())


def test_memory_does_not_grow_with_directions():
    """But for some hundred bytes of a direction's own numbers; a field of this grid has 32 kB."""
    scene = make_scene(random_values(16, 16, 16), g=0.3)
    few, many = saved_bytes(scene, 12), saved_bytes(scene, 96)
    assert many - few < 84 * 4000, (few, many)


def test_under_a_black_map_images_have_finite_derivatives_by_every_number():
    radiance = torch.zeros(3, 6, 8, dtype=torch.float64)
    light = light_of(radiance.requires_grad_(), 1.3, 20.0, directions=12)
    numbers = [light.radiance, light.scale.requires_grad_(), light.rotation.requires_grad_()]
    scene = replace(make_scene(half_empty(*SHAPE), g=0.4), lights=[light])
    slopes = torch.autograd.grad(render(scene).sum(), numbers)
    assert all(bool(torch.isfinite(slope).all()) for slope in slopes) and bool(slopes[0].any())
