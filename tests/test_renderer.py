"""The renderer as a whole: energy, symmetries and scalings of images, and their derivatives."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from media import assert_image_derivatives, half_empty, make_camera, make_scene, tensor

from ddrecon.cameras import cast_rays
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import UsageError
from ddrecon.grid import Grid
from ddrecon.lighting import solve_light
from ddrecon.picture import render, view_components
from ddrecon.scene import View
from ddrecon.validate.gradcheck import check_parameters

SHAPE = (5, 4, 6)
BOTH = {"directional": (3.0, 2.0, 1.0), "ambient": (0.3, 0.4, 0.5)}
INSIDE = {"eye": (0.1, 0.1, 0.2), "half_width": 0.8}


def components(scene):
    return view_components(solve_light(scene, SolveMemory()), scene, scene.views[0].camera)


# --- what images are made of ---


@pytest.mark.parametrize("model", ["p1", "none"])
@pytest.mark.parametrize("g", [0.0, 0.4, -0.5])
def test_components_sum_to_the_image_and_without_a_model_nothing_scatters_twice(g, model):
    scene = make_scene(half_empty(*SHAPE), g=g, model=model, **BOTH)
    parts = components(scene)
    together = parts.reduced + parts.single + parts.multiple
    torch.testing.assert_close(together, render(scene)[0], rtol=1e-14, atol=0)
    assert bool((parts.single > 0).any())
    assert bool((parts.multiple.abs() > 1e-15).any()) == (model == "p1")


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


def test_rays_that_meet_no_medium_show_exactly_what_is_behind():
    """Those that stay away from a ball in the middle of the box."""
    grid, radius = Grid((12, 13, 14), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), 0.35
    distance = sum(axis**2 for axis in grid.centers(tensor(0))).sqrt()
    camera = make_camera(size=(10, 10), half_width=0.25)
    lights = {"directional": None, "ambient": (1.0,)}
    scene = make_scene((distance < radius).double(), grid=grid, camera=camera, **lights)
    rays = cast_rays(camera)
    nearest = torch.linalg.cross(rays.origin, rays.direction).norm(dim=1)
    is_miss = (nearest > radius + 0.1).view(camera.size)
    image = render(scene)[0]
    assert bool(is_miss.any()) and bool((image[:, is_miss] == 1).all())
    assert bool((image[:, ~is_miss] < 1).any())


# --- scalings and symmetries ---


GRAY = {"sigma_a": (0.5,), "sigma_s": (6.0,), "directional": (3.0,), "ambient": (3.0,)}
COLORED = [
    {"directional": (3.0, 2.0, 1.0), "ambient": (3.0, 2.0, 1.0)},
    {"sigma_a": (0.5, 1.0, 2.0), "sigma_s": (8.0, 6.0, 4.0)},
]


@pytest.mark.parametrize("colored", COLORED, ids=["light", "medium"])
def test_each_color_is_a_gray_scene_of_its_own(colored):
    density = half_empty(*SHAPE)
    image = render(make_scene(density, g=0.4, **GRAY | colored))[0]
    for c in range(3):
        one = {name: color[c : c + 1] for name, color in colored.items()}
        gray = render(make_scene(density, g=0.4, **GRAY | one))[0, 0]
        # Corrections of masses have one bound, by the mean over colors.
        torch.testing.assert_close(image[c], gray, rtol=5e-4, atol=0)


# --- derivatives of whole images ---

ROUNDS = {"transport_rounds": 16, "transport_tolerance": 1e-2, "degree": 3}
CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "camera inside": {"g": -0.5, "view": INSIDE, "ambient": (0.5,), "directional": None},
    "one cell along z": {"shape": (1, 4, 5), "g": 0.4, **BOTH},
    "one cell along x": {"shape": (4, 5, 1), "g": -0.5, **BOTH},
    "no model": {"model": "none", "g": 0.4, **BOTH},
    "finer cells": {"shape": (2, 2, 3), "g": 0.4, "refine": 3, **ROUNDS, **BOTH},
    "cells in parts": {"shape": (2, 2, 3), "g": 0.4, "receive": 3, **ROUNDS, **BOTH},
}


@pytest.mark.parametrize("configuration", CONFIGURATIONS)
def test_derivatives_agree_in_both_modes_and_with_differences(configuration):
    """With those of other scenes in `tests/test_engines.py`."""
    options = dict(CONFIGURATIONS[configuration])
    shape, camera = options.pop("shape", SHAPE), make_camera(**options.pop("view", {}))
    scene = make_scene(half_empty(*shape, seed=7), camera=camera, **options)
    assert_image_derivatives(scene, ("density", "sigma_a", "sigma_s", "g"))


def test_the_derivative_by_g_is_that_of_both_modes_at_zero():
    """Where light's direction begins to matter, by forward mode as by reverse mode."""
    scene = make_scene(half_empty(*SHAPE, seed=7), g=0.0, **BOTH)
    report = check_parameters(scene, ("g",), 2, 0)
    assert report["checks"][0]["modes_error"] < 1e-10


def test_an_empty_volume_shows_the_background_as_it_is():
    """Whatever the camera does: a picture without the medium is such a picture."""
    scene = make_scene(half_empty(4, 5, 6), ambient=(0.3,))
    picture = torch.rand(3, *scene.views[0].camera.size, dtype=torch.float64)
    empty = replace(scene.volume, density=torch.zeros_like(scene.volume.density))
    response = {"exposure": tensor(1.3, 0.7, 2.0), "offset": tensor(0.1)}
    view = replace(scene.views[0], background=picture, **response)
    (shown,) = render(replace(scene, volume=empty, views=[view]))
    torch.testing.assert_close(shown, picture)


def test_a_picture_is_exposure_times_radiance_and_offset_and_what_shows_through():
    scene = make_scene(half_empty(4, 5, 6), ambient=(0.3,))
    view, zero = scene.views[0], tensor(0).view(1, 1, 1)

    def picture(**response):
        return render(replace(scene, views=[replace(view, **response)]))[0]

    dark, bright = picture(background=zero), picture(background=zero + 1)
    transmittance = bright - dark
    assert 0 < float(transmittance.min()) < float(transmittance.max()) <= 1 + 1e-12
    actual = picture(background=zero + 0.4, exposure=tensor(1.7), offset=tensor(0.05))
    expected = 1.7 * dark + transmittance * (0.4 - 0.05) + 0.05
    torch.testing.assert_close(actual, expected, rtol=1e-6, atol=1e-6)
