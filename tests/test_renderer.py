"""The renderer as a whole: energy, symmetries and scalings of images, and their derivatives."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import half_empty, make_camera, make_scene, random_values, tensor
from torch import Tensor

from ddrecon.cameras import Camera, cast_rays
from ddrecon.diffusion.cells import average_cells
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import UsageError
from ddrecon.grid import Grid
from ddrecon.light.lights import AmbientLight, DirectionalLight
from ddrecon.light.moments import flux_along_axes
from ddrecon.lighting import solve_light
from ddrecon.medium.coefficients import scale_medium
from ddrecon.picture import Components, render, view_components
from ddrecon.scene import Scene, View
from ddrecon.validate.gradcheck import GradientCheck, check_parameters

SHAPE = (5, 4, 6)
BOTH = {"directional": (3.0, 2.0, 1.0), "ambient": (0.3, 0.4, 0.5)}
INSIDE = {"eye": (0.1, 0.1, 0.2), "half_width": 0.8}
PARALLEL = {"eye": (0.4, 0.6, 2.5), "half_width": 0.7, "is_perspective": False}


def components(scene: Scene) -> Components:
    return view_components(solve_light(scene, SolveMemory()), scene, scene.views[0].camera)


# --- what images are made of ---


@pytest.mark.parametrize("g", [0.0, 0.4, -0.5])
def test_components_sum_to_the_image(g: float):
    scene = make_scene(half_empty(*SHAPE), g=g, **BOTH)
    parts = components(scene)
    together = parts.reduced + parts.single + parts.multiple
    torch.testing.assert_close(together, render(scene)[0], rtol=1e-14, atol=0)
    assert bool((parts.single > 0).any()) and bool((parts.multiple > 0).any())


@pytest.mark.parametrize("g", [0.0, 0.4, -0.5])
def test_without_a_model_nothing_scatters_twice(g: float):
    parts = components(make_scene(half_empty(*SHAPE), g=g, model="none", **BOTH))
    torch.testing.assert_close(parts.multiple, torch.zeros_like(parts.multiple), rtol=0, atol=1e-15)
    assert bool((parts.single > 0).any())


def test_without_scattering_only_reduced_light_is_seen():
    parts = components(make_scene(half_empty(*SHAPE), sigma_s=(0.0,), **BOTH))
    assert not parts.single.any() and not parts.multiple.any() and bool((parts.reduced > 0).all())


def test_what_scatters_nowhere_is_not_solved_for_cell_by_cell():
    settings, memory = {"sigma_a": (2.0,), "transport_rounds": 1, **BOTH}, SolveMemory()
    known = render(make_scene(half_empty(*SHAPE), sigma_s=(0.0,), **settings))
    by_cell = make_scene(half_empty(*SHAPE), sigma_s=0 * half_empty(1, *SHAPE), **settings)
    assert torch.equal(render(by_cell, memory=memory), known) and not memory.records


def test_reduced_light_is_ambient_light_attenuated():
    """A directional light is not seen: no pixel looks straight into it."""
    density, lights = half_empty(*SHAPE), BOTH | {"directional": None}
    expected = render(make_scene(density, sigma_a=(8.5, 7.0, 6.0), sigma_s=(0.0,), **lights))[0]
    reduced = components(make_scene(density, g=0.3, **BOTH)).reduced
    torch.testing.assert_close(reduced, expected, rtol=1e-12, atol=1e-14)


def test_views_are_rendered_by_name_and_must_agree_in_size():
    scene = make_scene(half_empty(*SHAPE))
    scene.views += [View("other", make_camera(eye=(-2.5, 0.0, 1.0)))]
    both = render(scene)
    for index, name in enumerate(["view", "other"]):
        torch.testing.assert_close(render(scene, name)[0], both[index], rtol=1e-12, atol=0)
    scene.views += [View("large", make_camera(size=(5, 5)))]
    with pytest.raises(UsageError, match="differ in size"):
        render(scene)


# --- white furnace ---

RADIUS = 0.35


def ball(thickness: float, g: float) -> Scene:
    grid = Grid((12, 13, 14), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    radius = sum(axis**2 for axis in grid.centers(torch.zeros(1, dtype=torch.float64))).sqrt()
    density = (radius < RADIUS).double() * thickness / (2 * RADIUS)
    white = {"sigma_a": (0.0,), "sigma_s": (1.0,), "directional": None, "ambient": (1.0,)}
    camera = make_camera(size=(10, 10), half_width=0.25)
    return make_scene(density, grid=grid, g=g, camera=camera, **white)


def misses(camera: Camera, radius: float) -> Tensor:
    """Which pixels' rays stay further than `radius` from the origin, [h, w]."""
    bundle = cast_rays(camera)
    along = (bundle.origin * bundle.direction).sum(1)
    return ((bundle.origin**2).sum(1) - along**2 > radius**2).view(camera.size)


@pytest.mark.parametrize(("thickness", "g"), [(0.0, 0.5), (1.0, 0.5), (10.0, -0.5), (10.0, 0.0)])
def test_a_white_furnace_is_white(thickness: float, g: float):
    """Albedo 1 under radiance 1 from everywhere: radiance 1, exactly so where nothing is."""
    scene = ball(thickness, g)
    image = render(scene)[0]
    is_miss = misses(scene.views[0].camera, RADIUS + 0.1)
    assert bool(is_miss.any()) and bool((image[:, is_miss] == 1).all())
    error = float((image - 1).abs().max())
    assert error < 1e-10 and (thickness > 0 or error == 0)


OTHERS = [{"scheme": "printed"}, {"model": "flux_limited"}]


@pytest.mark.parametrize("g", [0.0, 0.6])
@pytest.mark.parametrize("model", OTHERS, ids=str)
def test_a_white_furnace_of_another_model_has_its_color(model: dict[str, str], g: float):
    color = (1.0, 2.0, 3.0)
    medium = {"sigma_a": (0.0,), "sigma_s": (6.0,), "g": g, "directional": None}
    image = render(make_scene(half_empty(*SHAPE), ambient=color, **medium, **model))
    expected = torch.tensor(color).double().view(1, 3, 1, 1).expand_as(image)
    torch.testing.assert_close(image, expected, rtol=1e-10, atol=0)


@pytest.mark.parametrize("g", [0.5, 0.9, -0.5])
def test_a_slab_that_absorbs_nothing_passes_all_power_on(g: float):
    """The beam's power plus 4 pi / 3 L1 is the same at every depth of a wide slab."""
    grid, white = Grid((8, 1, 1), (0.0, 0.0, 0.0), (1.0, 1e9, 1e9)), {"sigma_a": (0.0,)}
    light = {"directional": (2.0,), "travel": (0.0, 0.0, 1.0)}
    density = random_values(*grid.shape)
    scene = make_scene(density, grid=grid, sigma_s=(3.0,), g=g, **white, **light)
    flux, _, _ = flux_along_axes(solve_light(scene, SolveMemory()).diffuse[1:4])
    cells = average_cells(scale_medium(scene.volume))
    depth = grid.spacing[0] * cells.extinction.value.flatten().cumsum(0)
    beam = 2.0 * torch.exp(-torch.cat([torch.zeros(1, dtype=torch.float64), depth]))
    power = (beam[1:] + beam[:-1]) / 2 + 4 * math.pi / 3 * flux.flatten()
    torch.testing.assert_close(power, power.mean().expand_as(power), rtol=1e-8, atol=0)
    assert 0 < power.mean() < 2


@pytest.mark.parametrize("g", [0.6, -0.6])
def test_a_parallel_camera_is_a_perspective_one_from_afar(g: float):
    far = 1e4
    images = []
    for half_width, is_near in ((0.45, False), (0.45 / far, True)):
        eye = (0.0, 0.6 * far, 0.8 * far)
        camera = make_camera(eye, half_width=half_width, is_perspective=is_near)
        images.append(render(make_scene(half_empty(*SHAPE), g=g, camera=camera)))
    torch.testing.assert_close(images[0], images[1], rtol=10 / far, atol=0)


# --- scalings and symmetries ---


@pytest.mark.parametrize("rounds", [0, 1])
def test_images_are_linear_in_light(rounds: int):
    scene = make_scene(half_empty(*SHAPE), g=0.4, transport_rounds=rounds, **BOTH)
    beam, ambient = scene.lights
    stronger = DirectionalLight(beam.direction, 2.5 * beam.irradiance)
    mixed = render(replace(scene, lights=[stronger, AmbientLight(0.5 * ambient.radiance)]))
    one, other = (render(replace(scene, lights=[light])) for light in (beam, ambient))
    torch.testing.assert_close(mixed, 2.5 * one + 0.5 * other, rtol=1e-10, atol=0)


GRAY = {"sigma_a": (0.5,), "sigma_s": (6.0,), "directional": (3.0,), "ambient": (3.0,)}
COLORED = [
    {"directional": (3.0, 2.0, 1.0), "ambient": (3.0, 2.0, 1.0)},
    {"sigma_a": (0.5, 1.0, 2.0), "sigma_s": (8.0, 6.0, 4.0)},
]


@pytest.mark.parametrize("colored", COLORED, ids=["light", "medium"])
def test_each_color_is_a_gray_scene_of_its_own(colored: dict):
    density = half_empty(*SHAPE)
    image = render(make_scene(density, g=0.4, **GRAY | colored))[0]
    for c in range(3):
        one = {name: color[c : c + 1] for name, color in colored.items()}
        gray = render(make_scene(density, g=0.4, **GRAY | one))[0, 0]
        # Corrections of masses have one bound, by the mean over colors.
        torch.testing.assert_close(image[c], gray, rtol=5e-4, atol=0)


@pytest.mark.parametrize("view", [{}, PARALLEL, INSIDE], ids=str)
def test_a_world_of_another_size_looks_the_same(view: dict):
    """All lengths times 3, all cross sections divided by 3."""
    scale, scene = 3.0, make_scene(half_empty(*SHAPE), g=0.4, camera=make_camera(**view), **BOTH)
    grid, camera, volume = scene.volume.grid, scene.views[0].camera, scene.volume
    lower, upper = (tuple(scale * end for end in ends) for ends in (grid.lower, grid.upper))
    pose = torch.cat([camera.pose[:, :3], scale * camera.pose[:, 3:]], 1)
    half_width = camera.half_width if camera.is_perspective else scale * camera.half_width
    sigmas = {"sigma_a": volume.sigma_a / scale, "sigma_s": volume.sigma_s / scale}
    volume = replace(volume, grid=Grid(SHAPE, lower, upper), **sigmas)
    views = [View("view", replace(camera, pose=pose, half_width=half_width))]
    large = replace(scene, volume=volume, views=views)
    torch.testing.assert_close(render(large), render(scene), rtol=1e-10, atol=0)


@pytest.mark.parametrize("g", [0.0, 0.4])
def test_a_mirrored_world_looks_mirrored(g: float):
    """Volume, light and camera mirrored in x, the light along no axis."""
    density, grid = half_empty(*SHAPE), Grid(SHAPE, (-0.5, -0.6, -0.4), (0.5, 0.6, 0.4))

    def image(density: Tensor, side: float) -> Tensor:
        camera, travel = make_camera((0.2 * side, 0.3, 2.5)), (-0.7 * side, -1.7, -1.5)
        return render(make_scene(density, grid=grid, g=g, travel=travel, camera=camera, **BOTH))

    mirrored = image(density.flip(2), -1).flip(-1)
    torch.testing.assert_close(mirrored, image(density, 1), rtol=1e-10, atol=0)


# --- derivatives of whole images ---

SKY = {"directional": None, "ambient": (0.5,)}
ROUNDS = {"transport_rounds": 16, "transport_tolerance": 1e-2, "degree": 3}
CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "isotropic, directional, perspective": {},
    "isotropic, ambient, orthographic": {"view": PARALLEL, **SKY},
    "forward, both, perspective": {"g": 0.4, **BOTH},
    "forward, both, camera inside": {"g": 0.4, "view": INSIDE, **BOTH},
    "backward, directional, orthographic": {"g": -0.5, "view": PARALLEL},
    "backward, ambient, camera inside": {"g": -0.5, "view": INSIDE, **SKY},
    "fields, both, perspective": {"has_fields": True, "g": 0.4, **BOTH},
    "fields, directional, orthographic": {"has_fields": True, "view": PARALLEL},
    "one cell along z": {"shape": (1, 4, 5), "g": 0.4, **BOTH},
    "one cell along y": {"shape": (4, 1, 5), "g": 0.4, **BOTH},
    "one cell along x": {"shape": (4, 5, 1), "g": -0.5, **BOTH},
    "gray": {"g": -0.5, **GRAY},
    "no model": {"model": "none", "g": 0.4, **BOTH},
    "finer cells": {"shape": (2, 2, 3), "g": 0.4, "refine": 3, **ROUNDS, **BOTH},
    "cells in parts": {"shape": (2, 2, 3), "g": 0.4, "receive": 3, **ROUNDS, **BOTH},
}


def build(configuration: dict[str, Any]) -> Scene:
    options = dict(configuration)
    shape, view = options.pop("shape", SHAPE), options.pop("view", {})
    if options.pop("has_fields", False):
        options["sigma_a"] = 2 * random_values(3, *shape, seed=8)
        options["sigma_s"] = 8 * random_values(3, *shape, seed=9)
    camera = make_camera(size=(3, 4), **view)
    return make_scene(half_empty(*shape, seed=7), camera=camera, **options)


def check(name: str, configuration: dict[str, Any]) -> GradientCheck:
    """Of derivatives of an image, along a random direction and by some entries."""
    return check_parameters(build(configuration), (name,), 2, 0, lambda names, _: names)[0]


BY_OTHERS = [
    (name, configuration)
    for name in ("sigma_a", "sigma_s", "g")
    for configuration in ("forward, both, perspective", "fields, both, perspective")
]


CASES = [*(("density", one) for one in CONFIGURATIONS), *BY_OTHERS]


@pytest.mark.parametrize(("name", "configuration"), CASES)
def test_derivatives_agree_in_both_modes_and_with_differences(name: str, configuration: str):
    result = check(name, CONFIGURATIONS[configuration])
    assert result.has_passed, result


def test_the_derivative_by_g_is_that_of_both_modes_at_zero():
    """Where light's direction begins to matter, by forward mode as by reverse mode."""
    assert check("g", {"g": 0.0, **BOTH}).modes_error < 1e-10


def test_an_empty_volume_shows_the_background_as_it_is() -> None:
    """Whatever the camera does: a picture without the medium is such a picture."""
    scene = make_scene(half_empty(4, 5, 6), ambient=(0.3,))
    picture = torch.rand(3, *scene.views[0].camera.size, dtype=torch.float64)
    empty = replace(scene.volume, density=torch.zeros_like(scene.volume.density))
    response = {"exposure": tensor(1.3, 0.7, 2.0), "offset": tensor(0.1)}
    view = replace(scene.views[0], background=picture, **response)
    (shown,) = render(replace(scene, volume=empty, views=[view]))
    torch.testing.assert_close(shown, picture)


def test_a_picture_is_exposure_times_radiance_and_offset_and_what_shows_through() -> None:
    scene = make_scene(half_empty(4, 5, 6), ambient=(0.3,))
    view, zero = scene.views[0], tensor(0).view(1, 1, 1)

    def picture(**response: torch.Tensor) -> torch.Tensor:
        return render(replace(scene, views=[replace(view, **response)]))[0]

    dark, bright = picture(background=zero), picture(background=zero + 1)
    transmittance = bright - dark
    assert 0 < float(transmittance.min()) < float(transmittance.max()) <= 1 + 1e-12
    shown = picture(background=zero + 0.4, exposure=tensor(1.7), offset=tensor(0.05))
    expected = 1.7 * dark + transmittance * (0.4 - 0.05) + 0.05
    torch.testing.assert_close(shown, expected, rtol=1e-6, atol=1e-6)
