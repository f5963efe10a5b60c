"""Light and derivatives stay finite, and light positive, where media jump, clog or are opaque."""

import pytest
import torch
from media import half_empty, make_camera, make_scene

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.lighting import solve_light
from ddrecon.picture import render

SHAPE = (6, 5, 7)


def hot_voxel(shape):
    """One cell of optical depth 1e4 under an extinction cross section of 1."""
    density = torch.zeros(shape, dtype=torch.float64)
    density[tuple(n // 2 for n in shape)] = 1e4 * max(shape)
    return density


def checkerboard(shape):
    return 1e3 * (sum(torch.meshgrid(*map(torch.arange, shape), indexing="ij")) % 2).double()


@pytest.mark.parametrize(
    ("density", "sigma_a", "sigma_s"),
    [
        (half_empty(*SHAPE), 10.0, 2.0),
        (hot_voxel(SHAPE), 0.5, 8.0),
        (checkerboard(SHAPE), 0.0, 8.0),
    ],
)
def test_isotropic_light_is_never_negative_in_the_dark(density, sigma_a, sigma_s):
    """An M-matrix with a source >= 0; with g not 0, -div(D kappa_s Q1) may make L0 dip below 0."""
    scene = make_scene(density, sigma_a=(sigma_a,), sigma_s=(sigma_s,), directional=(3.0,))
    mean = solve_light(scene, SolveMemory()).diffuse[0]
    assert float(mean.min()) >= -1e-12 * float(mean.max()) and float(render(scene).min()) >= 0


FINITE = {
    "checkerboard": (checkerboard(SHAPE), {}),
    "hot voxel": (hot_voxel(SHAPE), {}),
    "one cell": (half_empty(1, 1, 1), {}),
    # Squares overflow there; so do exponentials of what rounding makes of no depth.
    "thick": (1e10 * half_empty(*SHAPE), {}),
    "opaque": (1e20 * half_empty(*SHAPE), {}),
    # There the direction from the cell towards the camera is nothing but rounding.
    "eye in a center": (half_empty(*SHAPE), {"eye": (0.05, 0.0, -1 / 12), "half_width": 1.0}),
    "eye on a face": (half_empty(*SHAPE), {"eye": (0.0, 0.0, 0.5)}),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("case", FINITE)
def test_image_and_gradient_are_finite(case, dtype):
    density, view = FINITE[case]
    density = density.to(dtype).requires_grad_()
    camera = make_camera(dtype=dtype, **view)
    image = render(make_scene(density, camera=camera, g=0.4, ambient=(0.5,)))
    (gradient,) = torch.autograd.grad(image.sum(), density)
    assert bool(image.isfinite().all()) and bool(gradient.isfinite().all())
