"""A ground: closed forms, energy, derivatives and invariance."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from media import (
    LOWER,
    UPPER,
    assert_image_derivatives,
    light_of,
    make_camera,
    make_scene,
    random_values,
    tensor,
)

from ddrecon import lighting
from ddrecon.cameras import Camera, look_at
from ddrecon.errors import FormatError
from ddrecon.grid import Grid
from ddrecon.light.ground import Ground, Plane, hemisphere, look_up_texels, texel_centers
from ddrecon.light.lights import (
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    PointLight,
)
from ddrecon.light.sky import decompose_map
from ddrecon.march.ground import light_evenly, reflect
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.picture import render
from ddrecon.scene import View
from ddrecon.scene_file.build import load_scene

BALL = Path(__file__).parents[1] / "configs" / "ball.yaml"
SHAPE = (6, 7, 5)
pytestmark = pytest.mark.usefixtures("few_directions")
ALBEDO, HEIGHT = (0.6, 0.4, 0.2), -0.8
VIEW = {"eye": (0.5, 1.5, 2.5), "size": (6, 7), "half_width": 0.5}
"""Most of its picture is ground."""


def on_ground(density, height=HEIGHT, albedo=ALBEDO, **scene):
    camera = scene.pop("camera", make_camera(**VIEW))
    made = make_scene(density, camera=camera, **scene)
    return replace(made, ground=Ground(tensor(*albedo), Plane(height, 1)))


def test_an_empty_box_leaves_the_light_of_sun_lamp_beam_and_sky():
    scene = on_ground(torch.zeros(SHAPE, dtype=torch.float64), ambient=(0.2, 0.3, 0.5))
    scene.lights.append(PointLight(tensor(0.3, 1.0, -0.2), tensor(2.0)))
    down, up = (
        BeamLight(tensor(0, 9, 0), tensor(0, y, 0), tensor(5), tensor(0.9)) for y in (-2, 1)
    )
    scene.lights += [replace(down, radius=down.radius[0]), replace(up, radius=up.radius[0])]
    # straight from above, and only the plane is seen
    pose = look_at(tensor(0.1, 9, 0.2), tensor(0.1, 0, 0.2), tensor(0, 0, -1))
    scene.views = [View("above", Camera(pose, (5, 6), 3.0, is_perspective=False))]
    row, column = (torch.arange(n, dtype=torch.float64) + 0.5 - n / 2 for n in (5, 6))
    x, z = 0.1 + column[None], 0.2 + row[:, None]
    height = 1.0 - HEIGHT
    distance = ((x - 0.3) ** 2 + (z + 0.2) ** 2 + height**2).sqrt()
    sun = 3 * 2 / 3 + 2 * 5 / (math.pi * 0.9**2) * torch.exp(-2 * (x**2 + z**2) / 0.9**2)
    irradiance = sun + 2 * height / distance**3 + math.pi * tensor(0.2, 0.3, 0.5)[:, None, None]
    expected = tensor(*ALBEDO)[:, None, None] / math.pi * irradiance
    # the beam's radius is a little more: none is thinner than half a cell
    torch.testing.assert_close(render(scene)[0], expected, rtol=1e-7, atol=0)


@pytest.mark.parametrize("albedo", [tensor(*ALBEDO), random_values(3, 4, 6)], ids=["even", "map"])
def test_where_no_medium_is_near_a_ground_sends_back_its_part_of_sun_and_sky(albedo):
    scene = on_ground(torch.zeros(SHAPE, dtype=torch.float64), travel=(0.6, -0.8, 0.0))
    medium, sources = scale_medium(scene.volume), [*scene.lights, AmbientLight(tensor(0.5))]
    ground = replace(scene.ground, albedo=albedo)
    lit = light_evenly(ground, sources, medium.grid, scene.volume.density)
    even, more = reflect(lit, medium, scene.render)
    irradiance = 0.8 * scene.lights[0].irradiance + math.pi * 0.5
    torch.testing.assert_close(even, ground.mean_albedo / math.pi * irradiance)
    sent, part = even.view(3, 1, 1) + more, ground.albedo_on(*more.shape[1:]) / math.pi
    torch.testing.assert_close(sent, (part * irradiance).expand_as(sent))


@pytest.mark.parametrize("albedo", [0.0, 0.5])
def test_what_a_ground_hides_of_the_sky_is_not_scattered_once_either(albedo):
    """Light is followed in another way where its direction matters, even so little."""
    settings = {"directional": None, "ambient": (1.0,), "model": "none", "albedo": (albedo,)}
    even, directed = (render(on_ground(random_values(*SHAPE), g=g, **settings)) for g in (0, 1e-9))
    torch.testing.assert_close(directed, even, rtol=1e-7, atol=0)


def test_a_map_lies_under_the_box_from_low_to_high_and_beyond_it_is_its_mean():
    scene = on_ground(torch.zeros(SHAPE, dtype=torch.float64), travel=(0, -1, 0))
    rows, columns = 8, 10
    z, x = ((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in (rows, columns))
    scene.ground = Ground((0.2 + 0.5 * z[:, None] + 0.1 * x)[None], scene.ground.plane)
    pose = look_at(tensor(0, 9, 0.05), tensor(0, 0, 0.05), tensor(0, 0, -1))
    scene.views = [View("above", Camera(pose, (30, 30), 1.2, is_perspective=False))]
    row = 0.05 + 1.2 * (2 * (torch.arange(30, dtype=torch.float64) + 0.5) / 30 - 1)
    v, u = (row[:, None] - LOWER[0]) / (UPPER[0] - LOWER[0]), (row - 0.05 - LOWER[2]) / 0.9
    inside = ((v > 0) & (v < 1)) & ((u > 0) & (u < 1))
    v, u = v.clamp(0.5 / rows, 1 - 0.5 / rows), u.clamp(0.5 / columns, 1 - 0.5 / columns)
    expected = torch.where(inside, 0.2 + 0.5 * v + 0.1 * u, 0.5) * 3 / math.pi
    torch.testing.assert_close(render(scene)[0], expected.expand(3, -1, -1), rtol=1e-12, atol=0)


def test_an_even_map_is_a_number():
    scene = on_ground(random_values(*SHAPE), ambient=(0.2,), g=0.3, transport_rounds=1)
    known, ground = render(scene), scene.ground
    even = ground.albedo.view(3, 1, 1).expand(3, 5, 7)
    found = render(replace(scene, ground=replace(ground, albedo=even)))
    torch.testing.assert_close(found, known, rtol=1e-12, atol=0)


def test_a_slab_takes_from_the_ground_what_it_takes_from_the_sun():
    """Its shadow has the depth of a slanted way, and all of it together is all light it takes."""
    depth, cosine = 1.3, 0.8
    grid = Grid((12, 4, 16), (-0.6, 0.0, -0.8), (0.6, 0.2, 0.8))
    density = torch.ones(12, 4, 16, dtype=torch.float64)
    travel = (0.6, -cosine, 0.0)
    slab: dict[str, Any] = {"sigma_a": (depth / 0.2,), "sigma_s": (0.0,), "travel": travel}
    pose = look_at(tensor(3.0, 5, 0), tensor(3.0, 0, 0), tensor(0, 0, -1))
    camera = Camera(pose, (100, 200), 2.0, is_perspective=False)
    made = on_ground(density, -3.9, (1.0,), grid=grid, camera=camera, **slab)
    lost = 3 * cosine / math.pi - render(made)[0, 0]
    # The shadow's middle is 0.6 / 0.8 of the height to the side, at x = 3: amid the picture.
    expected = 3 * cosine / math.pi * -math.expm1(-depth / cosine)
    assert float(lost[45:55, 80:120].mean()) == pytest.approx(expected, rel=1e-3)
    # Rays are inside for a while, slanted: by the place where each meets the upper face's plane.
    place = torch.linspace(-0.95, 0.95, 3801, dtype=torch.float64)
    across = ((place + 0.15).clamp(max=0.8) - place.clamp(min=-0.8)).clamp(min=0)
    taken = 1.9 * float(-torch.expm1(-depth / 0.2 * across / 0.6).mean())
    total = 3 * cosine / math.pi * 1.2 * taken
    assert float(lost.mean()) * 4 * 2 == pytest.approx(total, rel=5e-3)


@pytest.mark.slow
def test_a_volume_takes_of_a_sky_what_it_takes_of_its_parallel_lights():
    """Those that are less bright than its mean take away: 7 % are left of texels."""
    around = (torch.arange(16, dtype=torch.float64) + 0.5) * (2 * math.pi / 16)
    sky = light_of((1 + 0.9 * around.sin()).expand(1, 8, 16), directions=24)
    mean, lights = decompose_map(sky)

    def taken(*lights):
        black = {"sigma_a": (3.0,), "sigma_s": (0.0,), "directional": None}
        seen = []
        for density in (torch.zeros(SHAPE), torch.ones(SHAPE)):
            scene = on_ground(density.double(), **black)
            settings = replace(scene.render, background=False)
            seen.append(render(replace(scene, lights=[*lights], render=settings)))
        return seen[0] - seen[1]

    pairs = [*zip(lights.travel.flip(-1), lights.irradiance, strict=True)]
    more, less = (
        taken(*(DirectionalLight(way, (sign * power).clamp(min=0)) for way, power in pairs))
        for sign in (1, -1)
    )
    known = taken(mean) + more - less
    assert float((taken(sky) - known).norm()) < 0.1 * float(known.norm())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["coarse", "maps"])
def test_tangent_adjoint_and_differences_agree(kind, monkeypatch):
    if kind == "coarse":
        monkeypatch.setattr(lighting, "MOST_CELLS", 4)
    model = {"transport_rounds": 1, "degree": 3}
    density = 0.2 + random_values(4, 5, 3)
    scene = on_ground(density, g=0.3, ambient=(0.3,), travel=(-2.0371, -2.2137, -1.0591), **model)
    scene.lights.append(PointLight(tensor(0.3137, 1.0, -0.2213), tensor(2.0)))
    beam = tensor(0.1137, 2.0, 0.0213), tensor(-0.2, -2.0, 0.1), tensor(2.0), tensor(0.3)[0]
    scene.lights.append(BeamLight(*beam))
    if kind == "maps":
        scene.ground = replace(scene.ground, albedo=random_values(3, 5, 9))
        sky = EnvironmentLight(random_values(1, 5, 8), tensor(1.0)[0], tensor(20.0)[0], 3)
        scene.lights.append(sky)
    names = "density", "ground.albedo", "lights.0.irradiance", "lights.0.direction"
    names += "lights.1.radiance", "lights.2.position", "lights.3.position", "lights.3.radius"
    assert_image_derivatives(scene, names, 1e-4)


def moved(scene, turns=0, size=1.0):
    """The same scene in other units, x, y and z taking each other's place `turns` times."""
    volume, ground, (view,) = scene.volume, scene.ground, scene.views
    assert ground is not None
    grid, axes = volume.grid, [(axis + turns) % 3 for axis in range(3)]
    lower, upper = ([size * end[axis] for axis in axes] for end in (grid.lower, grid.upper))
    pose = view.camera.pose.roll(turns, 0) * tensor(1, 1, 1, size)
    sun, sky, lamp = scene.lights
    place, intensity = size * lamp.position.roll(turns), size**2 * lamp.intensity
    grid = Grid(tuple(grid.shape[axis] for axis in axes), tuple(lower), tuple(upper))
    sigmas = volume.sigma_a / size, volume.sigma_s / size
    return replace(
        scene,
        volume=Volume(grid, volume.density.permute(axes), *sigmas, volume.phase),
        lights=[
            replace(sun, direction=sun.direction.roll(turns)),
            sky,
            PointLight(place, intensity),
        ],
        views=[View("view", replace(view.camera, pose=pose))],
        ground=Ground(ground.albedo, Plane(size * ground.plane.height, axes.index(1))),
    )


@pytest.mark.parametrize(("turns", "size"), [(0, 1e3), (1, 1.0), (2, 1.0)])
def test_units_and_the_way_up_do_not_matter(turns, size):
    scene = on_ground(random_values(*SHAPE), ambient=(0.2,), g=0.3, transport_rounds=1)
    scene.lights.append(PointLight(tensor(0.3, 1.0, -0.2), tensor(2.0)))
    found, known = render(moved(scene, turns, size)), render(scene)
    torch.testing.assert_close(found, known, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("power", [0.5, 1.0])
def test_even_light_from_a_hemisphere_has_its_irradiance(power):
    """The integral of the cosine, pi, whatever the axis and number of directions."""
    for axis, count in ((0, 5), (1, 24), (2, 1)):
        directions, angles = hemisphere(axis, count, power)
        torch.testing.assert_close(directions.norm(dim=1), torch.ones(count).double())
        assert float((directions[:, axis] * angles).sum()) == pytest.approx(math.pi)


def test_lights_from_below_are_hidden():
    scene = on_ground(random_values(*SHAPE))
    known = render(scene)
    scene.lights += [DirectionalLight(tensor(0.1, 1, 0), tensor(1.0))]
    scene.lights += [PointLight(tensor(0, -1, 0), tensor(1.0))]
    assert torch.equal(render(scene), known)


def test_texels_are_found_where_they_are():
    grid, plane = Grid(SHAPE, (-0.5, -0.6, -0.4), (0.5, 0.6, 0.5)), Plane(HEIGHT, 1)
    points = texel_centers(grid, plane, tensor(0))
    texels = random_values(2, *points.shape[:2])
    z, x = points[..., 0].flatten(), points[..., 2].flatten()
    torch.testing.assert_close(look_up_texels(texels, grid, plane, z, x), texels.flatten(1))
    assert float(z.max()) > 3 * grid.upper[0] and float(z.min()) < 3 * grid.lower[0]


GROUND = "ground={height: -2, albedo: 0.3}"


def test_a_map_is_read_as_it_is(tmp_path):
    gray = random_values(4, 6).float().numpy()
    for name, factor in (("a.npy", 1), ("b.npy", 2)):
        np.save(tmp_path / name, factor * gray)
    scene = load_scene(BALL, overrides=[GROUND, f"ground.albedo={{file: {tmp_path}/a.npy}}"])
    torch.testing.assert_close(scene.ground.albedo, torch.from_numpy(gray)[None])
    with pytest.raises(FormatError, match="an albedo is from 0 to 1"):
        load_scene(BALL, overrides=[GROUND, f"ground.albedo={{file: {tmp_path}/b.npy}}"])
