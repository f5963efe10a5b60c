"""Scenes at the edges of what is allowed: images and gradients stay finite, and single precision
follows double.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
import torch
from media import make_camera, make_scene
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.renderer import render, solve_light

SHAPE = (6, 5, 7)
BOTH = {"directional": (3.0,), "ambient": (0.5,)}
PRECISION = 1e-3
NO_DIRECTION = "eye at the center of a cell"
"""There the direction from the cell towards the camera is nothing but rounding, and g makes the
gradient depend on it.
"""


def empty(shape: tuple[int, int, int]) -> Tensor:
    return torch.zeros(shape, dtype=torch.float64)


def half_full(shape: tuple[int, int, int]) -> Tensor:
    return (
        2 * torch.rand(shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 1
    ).clamp(min=0)


def hot_voxel(shape: tuple[int, int, int]) -> Tensor:
    """One cell of optical depth 1e4 under an extinction cross section of 1."""
    density = empty(shape)
    density[tuple(n // 2 for n in shape)] = 1e4 * max(shape)
    return density


def checkerboard(shape: tuple[int, int, int]) -> Tensor:
    return 1e3 * (sum(torch.meshgrid(*map(torch.arange, shape), indexing="ij")) % 2).double()


CASES: dict[str, dict[str, Any]] = {
    "empty": {"density": empty},
    "empty, forward": {"density": empty, "g": 0.9},
    "albedo 1": {"sigma_a": (0.0,)},
    "albedo 0": {"sigma_a": (8.0,), "sigma_s": (0.0,)},
    "vacuum of cross sections": {"sigma_a": (0.0,), "sigma_s": (0.0,)},
    "hot voxel": {"density": hot_voxel, "sigma_a": (0.1,), "sigma_s": (0.9,)},
    "hot voxel, albedo 1, forward": {
        "density": hot_voxel,
        "sigma_a": (0.0,),
        "sigma_s": (1.0,),
        "g": 0.7,
    },
    "checkerboard": {"density": checkerboard, "sigma_a": (0.1,), "sigma_s": (0.9,)},
    "checkerboard, backward": {
        "density": checkerboard,
        "sigma_a": (0.1,),
        "sigma_s": (0.9,),
        "g": -0.5,
    },
    "g = 0.95": {"g": 0.95},
    "g = -0.95": {"g": -0.95},
    "one cell along z": {"shape": (1, 5, 7), "g": 0.4},
    "one cell along y": {"shape": (6, 1, 7), "g": 0.4},
    "one cell along x": {"shape": (6, 5, 1), "g": 0.4},
    "one cell": {"shape": (1, 1, 1), "g": 0.4},
    "light along x": {"travel": (1.0, 0.0, 0.0)},
    "light along -y": {"travel": (0.0, -1.0, 0.0), "g": 0.4},
    "light along z": {"travel": (0.0, 0.0, 1.0), "g": -0.4},
    "view along an axis": {
        "view": {"eye": (0.0, 0.0, 2.5), "size": (5, 5)},
        "travel": (0.0, 0.0, -1.0),
    },
    "view along an axis, parallel": {
        "view": {"eye": (0.0, 0.0, 2.5), "size": (5, 5), "is_perspective": False}
    },
    NO_DIRECTION: {"view": {"eye": (0.05, 0.0, -1 / 12), "half_width": 1.0}, "g": 0.4},
    "eye on a face": {"view": {"eye": (0.0, 0.0, 0.5)}},
}
each_case = pytest.mark.parametrize("name", CASES)
each_dtype = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)


@pytest.fixture(scope="module")
def rendered() -> Callable[[str, torch.dtype], tuple[Tensor, Tensor]]:
    """The image of a case, and the gradient of its sum by density; each computed once."""

    @cache
    def make(name: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        options = {"sigma_a": (0.5,), "sigma_s": (7.0,), **BOTH} | CASES[name]
        density, view = (
            options.pop("density", half_full)(options.pop("shape", SHAPE)),
            options.pop("view", {}),
        )
        density = density.to(dtype).requires_grad_()
        image = render(make_scene(density, camera=make_camera(dtype=dtype, **view), **options))
        return image.detach(), torch.autograd.grad(image.sum(), density)[0]

    return make


@each_dtype
@each_case
def test_image_and_gradient_are_finite(name: str, dtype: torch.dtype, rendered):
    image, gradient = rendered(name, dtype)
    assert bool(image.isfinite().all()) and bool(gradient.isfinite().all())
    assert image.dtype == gradient.dtype == dtype


@each_dtype
@each_case
def test_radiance_is_not_negative(name: str, dtype: torch.dtype, rendered):
    """Up to rounding, of sums whose terms are as large as the light."""
    assert float(rendered(name, dtype)[0].min()) > -10 * torch.finfo(dtype).eps


@each_case
def test_single_precision_follows_double(name: str, rendered):
    single, double = (rendered(name, dtype)[0].double() for dtype in (torch.float32, torch.float64))
    error = float((single - double).abs().max() / double.abs().max())
    assert error < PRECISION, f"{error:.1e}"


@pytest.mark.parametrize("name", [name for name in CASES if name != NO_DIRECTION])
def test_gradients_in_single_precision_follow_double(name: str, rendered):
    single, double = (rendered(name, dtype)[1].double() for dtype in (torch.float32, torch.float64))
    error = float(
        (single - double).norm() / double.norm().clamp(min=torch.finfo(torch.float32).tiny)
    )
    assert error < PRECISION, f"{error:.1e}"


@pytest.mark.parametrize("density", [half_full, hot_voxel, checkerboard])
@pytest.mark.parametrize(("sigma_a", "sigma_s"), [(10.0, 2.0), (0.5, 8.0), (0.0, 8.0)])
def test_isotropic_light_is_never_negative_in_the_dark(
    density: Callable[..., Tensor], sigma_a: float, sigma_s: float
):
    """An M-matrix with a source >= 0. With g not 0 its source holds -div(D kappa_s Q1), of either
    sign, and L0 may dip below zero.
    """
    scene = make_scene(density(SHAPE), sigma_a=(sigma_a,), sigma_s=(sigma_s,), directional=(3.0,))
    mean = solve_light(scene, SolveMemory()).outgoing.mean
    assert float(mean.min()) >= -1e-12 * float(mean.max()) and float(render(scene).min()) >= 0


def test_an_empty_volume_shows_the_background():
    image = render(make_scene(empty(SHAPE), directional=(3.0,), ambient=(0.3, 0.4, 0.5), g=0.4))[0]
    assert torch.equal(image, image.new_tensor([0.3, 0.4, 0.5]).view(3, 1, 1).expand_as(image))
