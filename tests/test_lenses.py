"""Lenses: rays go where OpenCV's formulas take them, and derivatives are those of the inverse."""

import math
from dataclasses import replace

import pytest
import torch
from media import make_camera, make_scene

from ddrecon.cameras import Camera, cast_rays, image_places, project
from ddrecon.lenses import distort, ray_through
from ddrecon.picture import render
from ddrecon.settings import RenderSettings

LENSES = {
    "opencv": [-0.25, 0.08, -0.01, 0.004, 0.002, -0.003],
    "fisheye": [0.04, -0.006, 6e-4, -2e-5],
}


def lens_of(model: str, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.tensor(LENSES[model], dtype=dtype)


def plainly(model: str, k: list[float], x: float, y: float, z: float) -> tuple[float, float]:
    """The image of a direction, as OpenCV's manual writes it; k4 of `opencv` as nerfstudio's."""
    a, b = x / z, y / z
    if model == "opencv":
        k1, k2, k3, k4, p1, p2 = k
        r2 = a * a + b * b
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
        return (
            a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
            b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b,
        )
    r = math.hypot(a, b)
    theta = math.atan(r)
    bent = theta * (1 + sum(c * theta ** (2 * n + 2) for n, c in enumerate(k)))
    return (bent / r * a, bent / r * b) if r else (0.0, 0.0)


@pytest.mark.parametrize("model", LENSES)
def test_a_direction_meets_the_image_where_the_manual_says(model: str) -> None:
    rays = [(0.0, 0.0, 1.0), (0.3, -0.2, 1.0), (-0.5, 0.4, 1.2), (0.01, 0.6, 0.9)]
    found = distort(model, lens_of(model), torch.tensor(rays, dtype=torch.float64))
    expected = [plainly(model, LENSES[model], *ray) for ray in rays]
    torch.testing.assert_close(found, torch.tensor(expected).to(found), rtol=0, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("model", LENSES)
def test_there_and_back(model: str, dtype: torch.dtype) -> None:
    """To rounding, from the axis to the corners; for a fisheye also sideways and behind."""
    steps = torch.linspace(-0.7, 0.7, 15, dtype=dtype)
    places = torch.cartesian_prod(steps, steps) * (3.0 if model == "fisheye" else 1.0)
    rays = ray_through(model, lens_of(model, dtype), places)
    again = distort(model, lens_of(model, dtype), rays)
    torch.testing.assert_close(again, places, rtol=0, atol=30 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("model", LENSES)
def test_derivatives_are_those_of_the_inverse(model: str) -> None:
    """In both modes; on the axis too, where a fisheye's angle has a kink that its rays have not."""
    places = torch.tensor([[0.0, 0.0], [0.4, -0.3], [-0.1, 0.5]], dtype=torch.float64)
    inputs = (lens_of(model).requires_grad_(), places.requires_grad_())
    assert torch.autograd.gradcheck(
        lambda *given: ray_through(model, *given), inputs, check_forward_ad=True, atol=1e-7
    )


@pytest.mark.parametrize("model", LENSES)
def test_without_distortion_it_is_a_pinhole_or_a_perfect_fisheye(model: str) -> None:
    places = torch.tensor([[0.0, 0.0], [0.6, 0.0], [0.3, -0.4]], dtype=torch.float64)
    ray = ray_through(model, torch.zeros_like(lens_of(model)), places)
    cosine = ray[:, 2] / ray.norm(dim=1)
    off = places.norm(dim=1)
    torch.testing.assert_close(cosine, off.cos() if model == "fisheye" else off.atan().cos())


def lens_camera(model: str | None, **changes: object) -> Camera:
    distortion = None if model is None else lens_of(model)
    camera = make_camera(size=(40, 36), half_width=0.35)
    return replace(camera, lens=model, distortion=distortion, **changes)


@pytest.mark.parametrize("model", LENSES)
def test_rays_of_pixels(model: str) -> None:
    """Off-center axis and oblong pixels; a coarser image has the same rays at its corners."""
    camera = lens_camera(model, principal_point=(0.45, 0.53), pixel_aspect=1.1)
    right, up, backward = camera.pose[:, :3].unbind(1)
    direction = cast_rays(camera).direction.flip(1)
    ray = torch.stack([direction @ right, -direction @ up, -direction @ backward], 1)
    found = distort(model, lens_of(model), ray)
    torch.testing.assert_close(found, image_places(camera), rtol=0, atol=1e-14)
    coarse = cast_rays(camera.resize(2), (0.0, 0.0)).direction[19]
    torch.testing.assert_close(coarse, cast_rays(camera, (0.0, 0.0)).direction[36 * 2 + 2])


@pytest.mark.parametrize("model", [None, *LENSES])
def test_a_point_is_found_in_the_largest_picture(model: str | None) -> None:
    """Of 2^28 pixels, whose rays alone would take gigabytes."""
    whole = lens_camera(model, size=(1, 1), principal_point=(0.45, 0.53))
    side = 2.0**14
    places = torch.tensor([[0.5, 0.5], [side - 0.5, 0.5], [9e3, 4e3]], dtype=torch.float64)
    rays = cast_rays(whole, *((row, column) for column, row in (places / side).tolist()))
    points = (rays.origin + 2 * rays.direction).flip(1)
    seen, _ = project(replace(whole, size=(2**14, 2**14)), points)
    torch.testing.assert_close(seen, places, rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", LENSES)
def test_interpolated_pixels_are_those_of_their_own_rays(model: str) -> None:
    """All rays meet in the eye, distorted or not: a lattice of rays serves them as well."""
    camera = lens_camera(model)
    lines = (torch.linspace(0.1, 3.0, n, dtype=torch.float64).sin() for n in (6, 8, 7))
    density = torch.einsum("z,y,x->zyx", *lines)
    scene = make_scene(density, camera=replace(camera, size=(120, 108)))
    own = render(replace(scene, render=RenderSettings(tolerance=0)))
    between = render(replace(scene, render=RenderSettings(tolerance=0.02)))
    assert not torch.equal(own, between)
    assert (own - between).square().mean().sqrt() < 0.02 * own.square().mean().sqrt()
