"""Media that emit light, against closed forms (E2.11)."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from media import half_empty, make_camera, make_scene

from ddrecon.cameras import Camera, look_at
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import use_engine
from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight
from ddrecon.lighting import solve_light
from ddrecon.medium.optics import WHITE, black_body_radiance
from ddrecon.picture import render, view_components
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import with_values

GRID = Grid((6, 5, 7), (-0.5, -0.6, -0.4), (0.5, 0.6, 0.5))
COLORS = torch.tensor([0.7, 0.3, 0.1], dtype=torch.float64)
ENGINES = ["torch", pytest.param("warp", marks=pytest.mark.slow)]


def glowing(density, emission, **more):
    """Seen by parallel rays along z, whose way through the box is 1."""
    camera = make_camera((0.0, 0.0, 2.5), (3, 3), 0.2, is_perspective=False)
    if isinstance(density, float):
        density = torch.full(GRID.shape, density, dtype=torch.float64)
    settings = {"directional": None, "sigma_a": (2.0,), "sigma_s": (0.0,)} | more
    return make_scene(density, grid=GRID, camera=camera, emission=emission, **settings)


def use(engine):
    if engine == "warp":
        pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
    use_engine(engine)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("model", ["p1", "none"])
@pytest.mark.parametrize("density", [0.0, 0.8])
def test_an_even_box_shines_by_its_length(engine, model, density):
    """(1 - exp(-kappa L)) j / kappa, or j L where it is empty."""
    use(engine)
    kappa = 2.0 * density
    length = (1 - math.exp(-kappa)) / kappa if kappa else 1.0
    image = render(glowing(density, COLORS, model=model))[0]
    torch.testing.assert_close(image, (COLORS * length).view(3, 1, 1).expand_as(image))


def test_an_image_is_the_sum_of_what_lamps_and_emission_show():
    """Light is linear in its sources; and emission in other units of length is the same picture."""
    density, emission = half_empty(*GRID.shape), half_empty(3, *GRID.shape, seed=1)
    settings = {"sigma_s": (5.0,), "transport_rounds": 2}
    lamp, glow, both = (
        glowing(density, of_volume, **settings, directional=of_lamp)
        for of_volume, of_lamp in ((None, (3.0,)), (emission, None), (emission, (3.0,)))
    )
    torch.testing.assert_close(render(lamp) + render(glow), render(both), rtol=1e-9, atol=1e-12)
    parts = view_components(solve_light(both, SolveMemory()), both, both.views[0].camera)
    black = glowing(density, emission, sigma_a=(7.0,))
    torch.testing.assert_close(parts.reduced, render(black)[0])


def test_a_black_body_follows_stefan_and_boltzmanns_kin():
    """Luminance 1 at a flame's temperature; hotter is brighter and bluer, cold is dark.

    By Wien's law luminance grows as exp(-c / T), c being h c / k over some 570 to 600 nm.
    """
    kelvin = torch.tensor([0.0, 1000.0, WHITE, 3000.0, 6500.0, 20000.0], dtype=torch.float64)
    colors = black_body_radiance(kelvin)
    luminance = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64) @ colors
    assert colors.shape == (3, len(kelvin)) and bool((colors >= 0).all()) and not luminance[0]
    assert bool((luminance.diff() > 0).all())
    assert bool((colors[2] / colors[0])[1:].diff().ge(0).all())
    assert float(luminance[2]) == pytest.approx(1, abs=0.05)
    rise = math.log(float(luminance[2] / luminance[1])) / (1 / 1000 - 1 / WHITE)
    assert 1.4388e7 / 610 < rise < 1.4388e7 / 560
    # daylight of 6500 K is nearly white
    assert float(colors[:, 4].max() / colors[:, 4].min()) == pytest.approx(1, abs=0.1)


ONE, OTHER = (-2.0, -2.1, -1.0), (1.2, -0.3, -1.9)
"""Two directions (x, y, z) that are along no axis of the grid."""


def unlike_its_mirror(cells):
    """A smooth density without symmetry, zero at the faces of the unit box."""
    grid = Grid((cells,) * 3, (0.0,) * 3, (1.0,) * 3)
    z, y, x = grid.centers(torch.zeros(1, dtype=torch.float64))
    hump = (torch.sin(math.pi * z) * torch.sin(math.pi * y) * torch.sin(math.pi * x)) ** 2
    return hump * (1 + 0.8 * torch.sin(3 * z + 2 * y) * torch.cos(4 * x))


def power_seen(scene, travel, towards):
    """What leaves along `towards` of light along `travel`, scattered once, and more often."""
    eye = torch.nn.functional.normalize(torch.tensor(towards, dtype=torch.float64), dim=0) * 3 + 0.5
    pose = look_at(eye, torch.full_like(eye, 0.5), eye.new_tensor([0.0, 1.0, 0.0]))
    camera = Camera(pose, (48, 48), 0.9, is_perspective=False)
    lit = replace(scene, lights=[DirectionalLight(eye.new_tensor(travel), eye.new_tensor([1.0]))])
    parts = view_components(solve_light(lit, SolveMemory()), lit, camera)
    return float(parts.single[0].mean()), float(parts.multiple[0].mean())


def asymmetry(cells, g):
    """How much the ways from ONE to OTHER and back differ, of single and of multiple scattering."""
    grid = Grid((cells,) * 3, (0.0,) * 3, (1.0,) * 3)
    scene = make_scene(unlike_its_mirror(cells), grid=grid, sigma_a=(1.0,), sigma_s=(12.0,), g=g)
    forth = power_seen(scene, ONE, OTHER)
    back = power_seen(scene, tuple(-c for c in OTHER), tuple(-c for c in ONE))
    single, multiple = (abs(a - b) / b for a, b in zip(forth, back, strict=True))
    return single, multiple


def test_light_and_camera_may_change_places():
    coarse, fine = (asymmetry(cells, 0.5) for cells in (12, 24))
    assert max(fine) < 0.002 and sum(fine) < 0.45 * sum(coarse), (coarse, fine)


ROOT = Path(__file__).parents[2]
CAMERA = "type: perspective, origin: [0, 0.3, 3.2], target: [0, 0, 0], fov: 28"
TRACED = [
    f"volume.density={{file: {ROOT}/data/plume/density.npz}}",
    *("volume.sigma_t=10", "volume.albedo=0.9"),
    *("volume.g=0", "diffusion={}", "optimize=", "render.samples_per_pixel=4"),
    f"views=[{{name: view, camera: {{{CAMERA}, resolution: [64, 64]}}}}]",
]
"""What was traced, beside the config."""


@pytest.mark.slow
def test_the_plumes_derivative_is_that_of_a_path_tracer():
    scene = load_scene(ROOT / "configs" / "plume.yaml", overrides=TRACED)
    density = scene.volume.density
    leaf = density.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(render(with_values(scene, {"density": leaf})).mean(), leaf)
    ours, amount = (
        torch.nn.functional.avg_pool3d(item[None], 4)[0].numpy()
        for item in (64 * gradient, density)
    )
    with np.load(ROOT / "data" / "plume" / "gradient.npz", allow_pickle=False) as archive:
        traced = archive["gradient_blocks4"]
    seen = amount > 0.05
    assert seen.sum() > 500
    assert np.corrcoef(ours[seen], traced[seen])[0, 1] > 0.95
    assert np.linalg.norm(ours[seen] - traced[seen]) < 0.2 * np.linalg.norm(traced[seen])
