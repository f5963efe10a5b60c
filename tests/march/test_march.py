"""View rays: what the box lets through and scatters towards the camera, by closed forms."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from media import box_grid, convergence_order, half_empty, make_camera, make_scene, march_rays
from torch import Tensor

from ddrecon.cameras import Rays, cast_rays
from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.reduced import follow_lights
from ddrecon.march import integral as march_module
from ddrecon.march.box import cross_box
from ddrecon.march.outgoing import OutgoingLight
from ddrecon.medium.coefficients import Volume, scale_medium
from ddrecon.picture import render
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings

CAMERAS = {
    "perspective": {},
    "oblique": {"eye": (1.5, 1.2, 1.8)},
    "orthographic": {"eye": (0.7, -0.4, 2.5), "half_width": 0.8, "is_perspective": False},
    "inside": {"eye": (0.1, 0.2, 0.15), "half_width": 1.0},
    "grazing": {"eye": (0.9, 0.0, 0.1), "half_width": 4.0},
}
each_camera = pytest.mark.parametrize("view", CAMERAS.values(), ids=CAMERAS.keys())


def emission_of(grid: Grid, density: Tensor) -> OutgoingLight:
    """A medium under one oblique beam and some smooth diffuse light that grows along x."""
    light = DirectionalLight(density.new_tensor([0.3, -1.0, -0.5]), density.new_tensor([2.0]))
    numbers = map(density.new_tensor, ([0.5], [2.0, 3.0], 0.3))
    medium = scale_medium(Volume(grid, density, *numbers))
    diffuse = (1 + grid.centers(density)[2]).expand(2, *grid.shape)
    matter, beams = (medium.extinction, medium.scattering), follow_lights(medium, [light])
    return OutgoingLight(grid, *matter, beams, diffuse, medium.seen, medium.peak)


def every_ray(steps: int) -> RenderSettings:
    """Settings by which all rays are marched themselves."""
    return RenderSettings(steps_per_voxel=steps, tolerance=0.0)


def chord(grid: Grid, origin: list[float], direction: list[float]) -> float:
    """The length of one ray inside the box, in front of its origin, face by face."""
    near, far = 0.0, math.inf
    for low, high, o, d in zip(grid.lower, grid.upper, origin, direction, strict=True):
        if d == 0 and not low < o < high:
            return 0.0
        if d != 0:
            near = max(near, min((low - o) / d, (high - o) / d))
            far = min(far, max((low - o) / d, (high - o) / d))
    return max(far - near, 0.0)


def chords(grid: Grid, bundle: Rays) -> Tensor:
    pairs = zip(bundle.origin.tolist(), bundle.direction.tolist(), strict=True)
    return bundle.origin.new_tensor([chord(grid, *pair) for pair in pairs])


@each_camera
@pytest.mark.parametrize("steps", [1, 3])
def test_a_homogeneous_box_attenuates_by_its_chord(view: dict, steps: int):
    grid, bundle = box_grid((3, 5, 4)), cast_rays(make_camera(size=(7, 6), **view))
    outgoing = emission_of(grid, torch.full(grid.shape, 0.7, dtype=torch.float64))
    transmittance = march_rays(outgoing, bundle, every_ray(steps))[1]
    lengths = chords(grid, bundle)
    assert bool((lengths > 0).any())
    expected = torch.exp(-outgoing.extinction.value[:, 0, 0, :1] * lengths)
    torch.testing.assert_close(transmittance, expected, rtol=1e-12, atol=0)


@each_camera
def test_rays_that_miss_the_box_see_nothing(view: dict):
    grid = box_grid((3, 5, 4))
    bundle = cast_rays(make_camera(size=(7, 6), **(view | {"half_width": 5.0})))
    outgoing = emission_of(grid, 0.1 + half_empty(*grid.shape))
    scattered, transmittance = march_rays(outgoing, bundle, every_ray(1))
    is_miss = chords(grid, bundle) == 0
    assert bool(is_miss.any()) or view is CAMERAS["inside"]
    assert not scattered[:, is_miss].any() and bool((transmittance[:, is_miss] == 1).all())
    assert bool((scattered[:, ~is_miss] > 0).all()) and bool((transmittance[:, ~is_miss] < 1).all())


def test_a_ray_that_rounding_tilts_runs_beside_a_volume_that_repeats():
    """Else it would come in so far away that no engine knows where."""
    grid = replace(box_grid((3, 5, 4)), periodic=(0, 2))
    above, along = torch.tensor([[[0, 1, 0]], [[0.6, -4e-17, 0.8]]], dtype=torch.float64)
    assert not len(cross_box(grid, Rays(above, along, None)).hit)


def test_a_box_behind_the_camera_is_not_seen():
    grid, bundle = box_grid((3, 5, 4)), cast_rays(make_camera())
    away = Rays(bundle.origin, -bundle.direction, bundle.eye)
    outgoing = emission_of(grid, 0.1 + half_empty(*grid.shape))
    scattered, transmittance = march_rays(outgoing, away, every_ray(1))
    assert not scattered.any() and bool((transmittance == 1).all())


@each_camera
def test_chunks_do_not_matter(view: dict, monkeypatch):
    """Neither to what is seen nor to its derivative."""
    density = (0.1 + half_empty(9, 11, 10)).requires_grad_()
    bundle = cast_rays(make_camera(size=(7, 6), **view))

    def marched() -> list[Tensor]:
        seen = march_rays(emission_of(box_grid((9, 11, 10)), density), bundle, every_ray(2))
        return [*seen, *torch.autograd.grad((seen[0] - seen[1]).square().sum(), density)]

    whole = marched()
    monkeypatch.setattr(march_module, "CHUNK_NODES", 40)
    monkeypatch.setattr(march_module, "CELLS_PER_NODE", 100)
    for one, other in zip(whole, marched(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-14)


THICKNESS, SIGMA_S, SIGMA_A = 1.5, 2.0, 0.5


def slab(cells: int, g: float, travel: tuple[float, float, float]) -> Scene:
    """A homogeneous slab seen straight on, along z, by a parallel camera, under parallel light."""
    grid = Grid((cells, 2, 2), (-THICKNESS / 2, -9.0, -9.0), (THICKNESS / 2, 9.0, 9.0))
    camera = make_camera(eye=(0.0, 0.0, 5.0), size=(1, 1), half_width=0.1, is_perspective=False)
    density = torch.ones(grid.shape, dtype=torch.float64)
    medium = {"sigma_a": (SIGMA_A,), "sigma_s": (SIGMA_S,), "g": g, "model": "none"}
    return make_scene(density, grid=grid, travel=travel, camera=camera, **medium)


@pytest.mark.parametrize(("g", "is_behind"), [(0.0, False), (-0.6, True)])
@pytest.mark.parametrize("steps", [1, 3])
def test_single_scattering_of_a_slab_is_its_closed_form(g: float, is_behind: bool, steps: int):
    """kappa_s p E / (4 pi) times the integral of exp(-2 kappa_t s), or of exp(-kappa_t L)."""
    kappa, cosine = SIGMA_A + SIGMA_S, -1.0 if is_behind else 1.0
    phase = (1 - g**2) / (1 + g**2 - 2 * g * cosine) ** 1.5
    decayed = THICKNESS * math.exp(-kappa * THICKNESS)
    if is_behind:
        decayed = -math.expm1(-2 * kappa * THICKNESS) / (2 * kappa)
    expected = SIGMA_S * phase * 3.0 / (4 * math.pi) * decayed
    settings = RenderSettings(steps_per_voxel=steps)
    for cells in (2, 8):
        image = render(replace(slab(cells, g, (0.0, 0.0, cosine)), render=settings))
        assert float(image.mean()) == pytest.approx(expected, rel=1e-12)


WIDTH, DENSITY = 0.1, 12.0


def test_more_steps_and_samples_keep_a_homogeneous_transmittance():
    """Background light through an absorbing box: the average over a pixel of exp(-kappa chord)."""
    absorbing = {"sigma_s": (0.0,), "directional": None, "ambient": (1.0,)}
    scene = make_scene(torch.ones(3, 5, 4, dtype=torch.float64), **absorbing)
    image = render(replace(scene, render=RenderSettings(samples_per_pixel=4, steps_per_voxel=2)))[0]
    offsets = itertools.product((0.25, 0.75), repeat=2)
    bundles = [cast_rays(scene.views[0].camera, offset) for offset in offsets]
    lengths = torch.stack([chords(scene.volume.grid, bundle) for bundle in bundles])
    for color, sigma in enumerate(scene.volume.sigma_a):
        expected = torch.exp(-sigma * lengths).mean(0)
        torch.testing.assert_close(image[color].flatten(), expected, rtol=1e-12, atol=0)


def test_the_transmittance_of_a_blob_converges_at_second_order():
    """A Gaussian ball that absorbs: exp(-kappa sqrt(2 pi) w exp(-b^2 / (2 w^2))) at distance b."""
    camera = make_camera(eye=(0.3, 0.4, 2.5), size=(6, 6), half_width=0.1)
    counts, errors = [10, 20, 40], []
    bundle = cast_rays(camera)
    closest = torch.linalg.cross(bundle.origin, bundle.direction).norm(dim=1)
    mass = DENSITY * WIDTH * math.sqrt(2 * math.pi) * torch.exp(-(closest**2) / (2 * WIDTH**2))
    expected = torch.exp(-SIGMA_A * mass).view(camera.size)
    for n in counts:
        grid = Grid((n, n + n // 3, n), (-0.5, -0.6, -0.45), (0.5, 0.6, 0.45))
        square = sum(axis**2 for axis in grid.centers(expected))
        density = DENSITY * torch.exp(-square / (2 * WIDTH**2))
        absorbing = {"sigma_a": (SIGMA_A,), "sigma_s": (0.0,), "ambient": (1.0,)}
        scene = make_scene(density, grid=grid, camera=camera, directional=None, **absorbing)
        errors.append(float((render(scene)[0, 0] - expected).norm() / expected.norm()))
    assert errors[-1] < 2e-3 and convergence_order([1 / n for n in counts], errors) >= 1.8, errors
