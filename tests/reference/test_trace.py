"""Mitsuba's images of our scenes: closed forms, places, and our images of light scattered once."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from media import make_camera, make_scene, random_values

from ddrecon.cameras import Camera, cast_rays, look_at
from ddrecon.grid import Grid
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight
from ddrecon.medium.phase import Blend, HenyeyGreenstein, PhaseFunction, Rayleigh, TwoLobe
from ddrecon.picture import render
from ddrecon.reference.mitsuba_scene import mitsuba_scene
from ddrecon.reference.trace import Traced, load_mitsuba, open_tracer
from ddrecon.settings import RenderSettings

pytestmark = pytest.mark.slow

pytest.importorskip("mitsuba", reason="the reference needs Mitsuba 3 (the extra `reference`)")

LOWER, UPPER = (-0.2, -0.8, -0.3), (0.8, 0.4, 0.5)
"""A box around (0.3, -0.2, 0.1), whose sides differ."""
CENTER = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
ONES = torch.ones(3, dtype=torch.float64)
COLORS = torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64)
SIDES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def passes(scene, count, samples, depth=-1):
    tracer = open_tracer(scene, scene.views, depth)
    return [tracer.trace(0, seed, samples) for seed in range(count)]


def seen_from(side, half_width, size, is_perspective=False):
    towards = CENTER.new_tensor(side)
    up = towards.roll(1) if 1.0 in side else CENTER.new_tensor((0.0, 1.0, 0.0))
    pose = look_at(CENTER + 2 * towards, CENTER, up)
    return Camera(pose, (size, size), half_width, is_perspective)


BLACK = {"sigma_s": (0.0,), "directional": None}


@pytest.mark.parametrize("side", SIDES)
def test_an_absorbing_box_transmits_by_beer_and_lambert_in_every_color(side):
    density, sigma = torch.full((2, 3, 2), 1.5, dtype=torch.float64), np.array([0.5, 1.0, 2.0])
    grid = Grid.from_xyz((2, 3, 2), LOWER, UPPER)
    camera = seen_from(SIDES[side], 0.2, 4)
    medium = {"sigma_a": tuple(sigma), "ambient": (1.0, 0.5, 0.2), **BLACK}
    scene = make_scene(density, grid=grid, camera=camera, **medium)
    length = dict(zip("xyz", np.subtract(UPPER, LOWER), strict=True))[side]
    means = np.array([image.mean((0, 1)) for image in passes(scene, 8, 256)])
    error = np.abs(means.mean(0) - [1.0, 0.5, 0.2] * np.exp(-1.5 * sigma * length))
    assert (error < 5 * means.std(0, ddof=1) / math.sqrt(len(means))).all()
    assert not passes(replace(scene, render=RenderSettings(background=False)), 1, 16)[0].any()


@pytest.mark.parametrize(
    ("side", "corner"), [("x", (0, 0, 0)), ("y", (2, 0, 4)), ("z", (2, 3, 0)), ("x", (2, 3, 0))]
)
def test_a_voxel_darkens_the_place_it_has(side, corner):
    density = torch.zeros(3, 4, 5, dtype=torch.float64)
    density[corner] = 8.0
    grid = Grid.from_xyz((5, 4, 3), LOWER, UPPER)
    camera = seen_from(SIDES[side], 0.65, 26)
    medium = {"sigma_a": (1.0,), "ambient": (1.0,), **BLACK}
    scene = make_scene(density, grid=grid, camera=camera, **medium)
    place = torch.stack(torch.broadcast_tensors(*grid.centers(density)))[:, *corner].flip(0)
    right, up, _ = camera.pose[:, :3].T @ (place - camera.pose[:, 3])
    darkness = 1 - passes(scene, 1, 64)[0].mean(-1)
    line = (np.arange(26) + 0.5 - 13) / 13 * 0.65
    place = (darkness.sum(0) @ line / darkness.sum(), -darkness.sum(1) @ line / darkness.sum())
    np.testing.assert_allclose(place, (right, up), atol=0.3 * min(grid.spacing))


def soft_ball(cells):
    """A ball that is denser towards +x, on cells that are no cubes."""
    grid = Grid.from_xyz((cells, cells, cells), LOWER, UPPER)
    z, y, x = grid.centers(CENTER)
    radius = ((x - CENTER[0]) ** 2 + (y - CENTER[1]) ** 2 + (z - CENTER[2]) ** 2).sqrt()
    return grid, torch.sigmoid((0.28 - radius) / 0.05) * (1 + x)


def sky():
    """A map [3, 8, 16] without symmetry, one pixel of it bright."""
    down = torch.linspace(1, 0.1, 8, dtype=torch.float64)
    radiance = (COLORS.view(3, 1, 1) * down.view(8, 1)).repeat(1, 1, 16)
    radiance[:, 2, 5] += 40
    return radiance


FINE = RenderSettings(samples_per_pixel=16, steps_per_voxel=2, background=False)
LIGHTS: dict[str, Callable[[], list[Light]]] = {
    "directional": lambda: [DirectionalLight(-torch.tensor([2.0, 2.0, 1.0]).double(), COLORS)],
    "ambient": lambda: [AmbientLight(COLORS)],
    "environment": lambda: [EnvironmentLight(sky(), ONES[0], 40 * ONES[0])],
    "environment and ambient": lambda: [
        EnvironmentLight(sky(), 0.5 * ONES[0], -70 * ONES[0], up="z"),
        AmbientLight(COLORS),
    ],
    "point": lambda: [PointLight(CENTER + torch.tensor([1.0, 1.5, 0.5]), COLORS)],
}


@pytest.mark.parametrize("light", LIGHTS)
def test_light_scattered_once_is_ours_to_4_percent(light):
    grid, density = soft_ball(12)
    is_perspective = light not in ("directional", "environment")
    half_width = 0.25 if is_perspective else 0.5
    camera = seen_from((0.5, 0.3, 0.8), half_width, 16, is_perspective)
    camera = replace(camera, pixel_aspect=1.0 if is_perspective else 1.3)
    medium = {"sigma_a": (0.5, 1.0, 2.0), "sigma_s": (3.0, 2.0, 1.0), "g": 0.3}
    scene = make_scene(density, grid=grid, camera=camera, model="none", **medium)
    scene = replace(scene, lights=LIGHTS[light](), render=FINE)
    traced = Traced.of(passes(scene, 8, 128, depth=2))
    ours = render(scene)[0].permute(1, 2, 0).numpy()
    assert traced.noise < 0.05
    assert traced.error(ours) < 0.04
    assert ours.mean() == pytest.approx(traced.image.mean(), rel=0.03)


PHASES: dict[str, PhaseFunction] = {
    "two lobes": TwoLobe(CENTER.new_tensor([0.7, -0.5]), CENTER.new_tensor(0.6)),
    "blend": Blend(
        Rayleigh(CENTER),
        HenyeyGreenstein(CENTER.new_tensor(0.7)),
        torch.linspace(0, 1, 12).to(CENTER).expand(12, 12, 12),
    ),
    "by color": HenyeyGreenstein(CENTER.new_tensor([0.5, 0.0, -0.5])),
}


@pytest.mark.parametrize("phase", PHASES.values(), ids=PHASES.keys())
def test_every_phase_function_is_theirs(phase):
    """As `blendphase`, `rayleigh` and `tabphase`, and color by color."""
    grid, density = soft_ball(12)
    camera = seen_from((0.5, 0.3, 0.8), 0.2, 8, True)
    medium = {"sigma_a": (0.5,), "sigma_s": (3.0,), "model": "none"}
    scene = make_scene(density, grid=grid, camera=camera, **medium)
    lights = [*LIGHTS["directional"](), *LIGHTS["point"]()]
    scene = replace(scene, lights=lights, render=FINE)
    scene.volume.phase = phase
    traced = Traced.of(passes(scene, 8, 128, depth=2))
    ours = render(scene)[0].permute(1, 2, 0).numpy()
    assert traced.noise < 0.06 and traced.error(ours) < 0.03
    np.testing.assert_allclose(ours.mean((0, 1)), traced.image.mean((0, 1)), rtol=0.02)


def test_the_background_is_seen_where_we_see_it():
    grid, density = soft_ball(8)
    camera = seen_from((0.5, 0.3, 0.8), 1.2, 16, True)
    scene = make_scene(density, grid=grid, sigma_a=(20.0,), camera=camera, model="none", **BLACK)
    settings = RenderSettings(samples_per_pixel=64)
    scene = replace(scene, lights=LIGHTS["environment"](), render=settings)
    traced = Traced.of(passes(scene, 8, 64))
    assert traced.error(render(scene)[0].permute(1, 2, 0).numpy()) < 0.02


@pytest.mark.parametrize("axis", [1, 2])
def test_a_map_on_the_ground_is_seen_where_we_see_it(axis):
    """Turned or mirrored it is another picture."""
    side = torch.eye(3, dtype=torch.float64)[2 - axis]
    camera = seen_from(tuple((side + 0.2 * side.roll(1)).tolist()), 0.5, 16)
    scene = make_scene(torch.zeros(2, 2, 2, dtype=torch.float64), camera=camera, model="none")
    albedo = torch.tensor([[0.1, 0.1, 0.9], [0.1, 0.5, 0.1]], dtype=torch.float64)
    scene.ground = Ground(albedo.expand(3, 2, 3), Plane(scene.volume.grid.lower[axis], axis))
    scene = replace(scene, lights=[DirectionalLight(-side, COLORS)], render=FINE)
    traced = Traced.of(passes(scene, 2, 32))
    assert traced.error(render(scene)[0].permute(1, 2, 0).numpy()) < 0.05


def test_seeds():
    scene = make_scene(random_values(3, 4, 5))
    first, second = passes(scene, 2, 4)
    assert np.array_equal(first, passes(scene, 1, 4)[0]) and not np.array_equal(first, second)


def test_nothing_and_nothing_that_shines():
    empty = make_scene(torch.zeros(2, 2, 2, dtype=torch.float64), ambient=(0.5,))
    np.testing.assert_allclose(passes(empty, 1, 4)[0], 0.5, rtol=1e-6)
    assert not passes(replace(empty, lights=[]), 1, 4)[0].any()


def test_an_off_center_camera_is_theirs():
    """Mitsuba's own rays through the corners of the film are ours."""
    mitsuba = load_mitsuba()
    camera = replace(make_camera(size=(4, 6), half_width=0.4), principal_point=(0.3, 0.65))
    scene = make_scene(random_values(3, 4, 5), camera=camera)
    sensor = mitsuba_scene(scene, scene.views)["sensor_0"]
    sensor["to_world"] = mitsuba.ScalarTransform4f(sensor["to_world"])
    theirs = mitsuba.load_dict(sensor)
    for corner, index in (((0.0, 0.0), 0), ((1.0, 1.0), -1)):
        point = mitsuba.ScalarPoint2f
        ray, _ = theirs.sample_ray(0.0, 0.5, point(*corner), point(0.5))
        ours = cast_rays(camera, corner).direction[index].flip(-1)
        np.testing.assert_allclose(np.array(ray.d).ravel(), ours, atol=1e-6)
