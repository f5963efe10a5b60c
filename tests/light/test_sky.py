"""Lamps and skies: closed forms, what maps shed, and agreement with simpler lights."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from media import (
    box_grid,
    convergence_order,
    count_kept,
    half_empty,
    light_of,
    make_camera,
    make_scene,
    random_values,
    tensor,
)
from torch.autograd import forward_ad

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid, array_order
from ddrecon.light.lights import DirectionalLight, EnvironmentLight, PointLight
from ddrecon.light.moments import flux_along_axes
from ddrecon.light.point_light import follow_point_light, receive_point_light
from ddrecon.light.reduced import sum_unscattered_sky
from ddrecon.light.sky import (
    MAX_SUNS,
    count_suns,
    decompose_map,
    environment_radiance,
    fibonacci_sphere,
    pixel_moments,
    refine_map,
)
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.picture import render

SHAPE = (5, 4, 6)


def uneven(height, width, seed=0):
    """A map [3, h, w] with one small bright spot in it, which is a sun."""
    radiance = random_values(3, height, width, seed=seed)
    radiance[:, height // 3, width // 5] += 3 * height * width
    return radiance


def banded(height, width):
    """A map [3, h, w] without suns, bright on one side and dark on the other."""
    around = (torch.arange(width, dtype=torch.float64) + 0.5) * (2 * math.pi / width)
    return (1 + torch.sin(around)).expand(3, height, width) + uneven(height, width).clamp(max=1)


def center(row, column, height, width):
    """The direction (x, y, z) of a pixel, from -z over +x around."""
    down, around = math.pi * row / (height - 1), 2 * math.pi * (column + 0.5) / width
    return math.sin(down) * math.sin(around), math.cos(down), -math.sin(down) * math.cos(around)


def hot_pixel(height, width, row, column):
    """A map black but for one pixel, and the parallel light it is, by its solid angle."""
    radiance = torch.zeros(3, height, width, dtype=torch.float64)
    radiance[:, row, column] = torch.tensor([300.0, 200.0, 100.0])
    solid_angle = math.sin(math.pi * row / (height - 1)) * math.pi / (height - 1)
    power = radiance[:, row, column] * solid_angle * 2 * math.pi / width
    sun = DirectionalLight(-tensor(*center(row, column, height, width)), power)
    return light_of(radiance), sun


def relative_error(found, expected):
    return float((found - expected).norm() / expected.norm())


@pytest.mark.parametrize("count", [1, 7, 48])
def test_directions_are_spread_evenly(count):
    directions = fibonacci_sphere(count)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, rtol=1e-14)
    closest = np.sort(directions @ directions.T, axis=1)[:, -2] if count > 1 else np.array([-1.0])
    assert np.arccos(closest).min() > 0.6 * math.sqrt(4 * math.pi / count) or count == 1


@pytest.mark.parametrize("directions", [1, 6, 48])
@pytest.mark.parametrize("size", [(2, 3), (5, 8), (32, 64)], ids=str)
def test_power_and_first_moment_of_a_map_are_those_of_its_parts(size, directions):
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
def test_a_constant_map_is_ambient_light_whatever_the_directions(directions):
    color = torch.tensor([0.7, 0.2, 0.0], dtype=torch.float64)
    even = color.view(3, 1, 1).expand(3, 6, 8)
    ambient, sky = decompose_map(light_of(even, directions=directions))
    assert torch.equal(ambient.radiance, color) and not sky.irradiance.any()


@pytest.mark.parametrize("place", [(32, 64, 16, 0), (16, 32, 12, 31)], ids=str)
def test_a_hot_pixel_is_a_directional_light(place):
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


def test_memory_does_not_grow_with_directions():
    density = random_values(16, 16, 16).requires_grad_()
    medium = scale_medium(replace(make_scene(density.detach(), g=0.3).volume, density=density))

    def sky(directions):
        parts = decompose_map(light_of(uneven(16, 32).requires_grad_(), directions=directions))
        return sum_unscattered_sky(medium, parts, degree=1).sum()

    few, many = (count_kept(lambda n=n: sky(n), density.numel()) for n in (12, 96))
    assert few == many


def test_under_a_black_map_images_have_finite_derivatives_by_every_number():
    radiance = torch.zeros(3, 6, 8, dtype=torch.float64)
    light = light_of(radiance.requires_grad_(), 1.3, 20.0, directions=12)
    numbers = [light.radiance, light.scale.requires_grad_(), light.rotation.requires_grad_()]
    scene = replace(make_scene(half_empty(*SHAPE), g=0.4), lights=[light])
    slopes = torch.autograd.grad(render(scene).sum(), numbers)
    assert all(bool(torch.isfinite(slope).all()) for slope in slopes) and bool(slopes[0].any())


SIZES = [(2, 3), (3, 4), (7, 5), (32, 64)]


def directions(count, seed=0):
    """Unit directions (x, y, z)."""
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1
    )


def seen(light, *direction):
    """What is seen along one direction (x, y, z), of any length."""
    vector = torch.nn.functional.normalize(light.radiance.new_tensor(direction), dim=0)
    return environment_radiance(light, array_order(vector)[None])[:, 0].tolist()


@pytest.mark.parametrize(("height", "width"), SIZES[1:], ids=str)
def test_a_pixel_is_seen_in_its_direction(height, width):
    light = light_of(random_values(2, height, width))
    for row, column in ((1, 0), (1, width - 1), (height - 2, 1)):
        assert seen(light, *center(row, column, height, width)) == pytest.approx(
            light.radiance[:, row, column].tolist(), rel=1e-12
        )


def test_between_pixels_radiance_is_their_mean_also_across_the_seam():
    light = light_of(random_values(1, 5, 8))
    corners = light.radiance[0, 1:3][:, [7, 0]].mean().item()
    assert seen(light, *center(1.5, -0.5, 5, 8)) == pytest.approx([corners], rel=1e-12)


@pytest.mark.parametrize(("up", "way"), [("y", (0, 1, 0)), ("z", (0, 0, 1))])
def test_straight_up_and_down_are_the_first_and_last_row(up, way):
    rows = torch.tensor([2.0, 7.0, 3.0], dtype=torch.float64)
    light = light_of(rows.view(1, 3, 1).expand(1, 3, 4), rotation=20.0, up=up)
    assert seen(light, *way) == pytest.approx([2.0])
    assert seen(light, *(-part for part in way)) == pytest.approx([3.0])


@pytest.mark.parametrize(("height", "width"), SIZES[1:3], ids=str)
def test_moments_integrate_the_bilinear_map(height, width):
    """Against a sum over 300 x 600 directions."""
    light = light_of(random_values(1, height, width))
    rows, columns = 300, 600
    down = math.pi * (torch.arange(rows, dtype=torch.float64) + 0.5) / rows
    around = 2 * math.pi * (torch.arange(columns, dtype=torch.float64) + 0.5) / columns
    down, around = (part.flatten() for part in torch.meshgrid(down, around, indexing="ij"))
    ways = torch.stack([down.sin() * around.sin(), down.cos(), -down.sin() * around.cos()], -1)
    solid_angle = down.sin() * (math.pi / rows) * (2 * math.pi / columns)
    weight = environment_radiance(light, array_order(ways))[0] * solid_angle
    expected = torch.cat([weight.sum()[None], weight @ ways])
    radiances = (torch.from_numpy(pixel_moments(height, width)) * light.radiance).sum((1, 2))
    torch.testing.assert_close(radiances, expected, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("size", [(9, 9), (24, 48), (25, 10)], ids=str)
def test_a_refined_map_is_the_same_function(size):
    radiance, ways = random_values(2, 7, 5), array_order(directions(100))
    fine = refine_map(radiance, *size)
    assert fine.shape[1] >= size[0] and fine.shape[2] >= size[1]
    radiances, known = (environment_radiance(light_of(one), ways) for one in (fine, radiance))
    torch.testing.assert_close(radiances, known, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("name", ["radiance", "scale", "rotation", "direction"])
def test_what_is_seen_has_both_derivatives(name):
    values = {"radiance": random_values(2, 4, 5), "scale": random_values()}
    values |= {"rotation": 100 * random_values(seed=1), "direction": array_order(directions(6))}

    def look(value):
        *light, direction = (values | {name: value}).values()
        return environment_radiance(EnvironmentLight(*light), direction)

    leaf = values[name].clone().requires_grad_()
    assert torch.autograd.gradcheck(look, leaf, check_forward_ad=True)


def test_straight_up_has_finite_derivatives():
    light = light_of(random_values(2, 4, 5))
    way = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(environment_radiance(light, way).sum(), way)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(way.detach(), torch.ones_like(way))
        tangent = forward_ad.unpack_dual(environment_radiance(light, dual)).tangent
    assert torch.isfinite(slope).all() and torch.isfinite(tangent).all()


OUTSIDE, INSIDE = (0.3, 1.7, 1.1), (0.11, 0.13, 0.17)


def light_at(position):
    return PointLight(tensor(*position), tensor(2.0))


def medium_of(grid, density, g=0.4):
    return scale_medium(Volume(grid, density, tensor(0.5), tensor(3.0), tensor(g)[0]))


def offsets(grid, position):
    """From the light to the cell centers, `[z, y, x, 3]` in array order."""
    axes = torch.broadcast_tensors(*grid.centers(tensor(0)))
    return torch.stack(axes, -1) - tensor(*position[::-1])


def cell_center(grid, *cell):
    """The center (x, y, z) of a cell (z, y, x)."""
    return tuple(offsets(grid, (0.0, 0.0, 0.0))[cell].flip(0).tolist())


@pytest.mark.parametrize("position", [OUTSIDE, INSIDE], ids=["outside", "inside"])
def test_without_a_medium_light_falls_with_the_square_of_the_distance(position):
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
def test_in_a_homogeneous_box_depth_is_path_length(position):
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
def test_a_light_on_a_cell_is_finite_with_finite_derivatives(where):
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
