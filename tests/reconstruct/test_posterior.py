"""Samples of the posterior, against the covariance written as a matrix on a grid of 6^3 cells."""

from dataclasses import replace

import pytest
import torch
from media import make_camera, make_scene, random_values
from torch import Tensor

from ddrecon.losses import Target
from ddrecon.numerics.conjugate_gradients import conjugate_gradients
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import View
from ddrecon.settings import ParameterSettings
from ddrecon.uncertainty.posterior import Posterior, generator_of

SHAPE = (6, 6, 6)
CELLS = 216
SIZE = (3, 4)
POWER, NOISE = 0.3, 0.02


@pytest.fixture(scope="module")
def curvature() -> Curvature:
    """Two gray views of a smoothed density that is nowhere near 0."""
    density = 1 + random_values(*SHAPE)
    scene = make_scene(density, sigma_a=(0.5,), sigma_s=(4.0,), transport_rounds=0)
    eyes = {"one": (0.2, 0.3, 2.5), "two": (2.4, -0.3, 0.5)}
    image = random_values(1, *SIZE, seed=2).expand(3, -1, -1)
    views = [View(name, make_camera(eye, SIZE), image) for name, eye in eyes.items()]
    settings = ParameterSettings(tv=1e-3)
    parameter = Parameter("density", settings, 0.1, density, scene.volume.grid)
    targets = {view.name: Target.of(image, None) for view in views}
    return Curvature(replace(scene, views=views), [parameter], targets, POWER)


@pytest.fixture(scope="module")
def jacobian(curvature: Curvature) -> Tensor:
    """J of the first color [24, cells], row by row. From now on `curvature` uses it, being faster.

    That both are the same is for `test_curvature` to say.
    """
    rows = []
    for name, image in curvature.images.items():
        for pixel in range(image[0].numel()):
            one = {other: torch.zeros_like(each) for other, each in curvature.images.items()}
            one[name][0].view(-1)[pixel] = 1
            rows.append(curvature.adjoint(one))
    found = torch.stack(rows)

    def tangents(vector: Tensor) -> dict[str, Tensor]:
        parts = (found @ vector).view(2, 1, *SIZE).expand(-1, 3, -1, -1)
        return dict(zip(curvature.images, parts, strict=True))

    def adjoint(pictures: dict[str, Tensor]) -> Tensor:
        return torch.stack([p.sum(0) for p in pictures.values()]).flatten() @ found

    curvature.tangents, curvature.adjoint = tangents, adjoint
    return found


TEMPERATURE = NOISE**2 / 12


def exact(curvature: Curvature, posterior: Posterior, jacobian: Tensor) -> Tensor:
    """H, of three equal colors, written out."""
    weights = torch.cat([w.expand(3, *SIZE)[0].flatten() for w in curvature.weights.values()])
    prior = torch.stack([posterior.prior.product(row) for row in torch.eye(CELLS).double()])
    return 3 * jacobian.T @ (weights[:, None] * jacobian) + prior


def test_a_sample_is_what_the_exact_covariance_says(curvature: Curvature, jacobian: Tensor) -> None:
    nothing = torch.zeros(CELLS, dtype=torch.float64)
    posterior = Posterior(curvature, nothing, TEMPERATURE, seed=3, tolerance=1e-4)
    posterior.low.fill_(-torch.inf)  # no bounds: then the posterior is a Gaussian
    inverse = exact(curvature, posterior, jacobian)
    covariance = TEMPERATURE * torch.linalg.inv(inverse)
    # Deviations of some cells: each is a solve for a unit vector.
    for cell in (43, 215):
        unit = torch.zeros(CELLS, dtype=torch.float64)
        unit[cell] = TEMPERATURE
        variance = float(posterior._correct(unit, nothing > 0, 200, 1e-6).value[cell])
        assert variance**0.5 == pytest.approx(float(covariance[cell, cell]) ** 0.5, rel=0.02)
    # Whitened, samples are independent standard normal numbers, in every direction at once.
    samples = torch.stack([posterior.sample(number).change for number in range(8)])
    squares = (samples @ (inverse / TEMPERATURE) * samples).sum(1)
    assert float(squares.mean()) / CELLS == pytest.approx(1, abs=4 * (2 / (8 * CELLS)) ** 0.5)


def test_within_bounds_a_sample_is_the_least_of_its_quadratic(
    curvature: Curvature, jacobian: Tensor
) -> None:
    pressed = torch.where(torch.arange(CELLS) % 3 == 0, 1e-7, 0).double()
    posterior = Posterior(curvature, 0 * pressed, TEMPERATURE, seed=3, tolerance=1e-5)
    posterior.low = torch.where(torch.arange(CELLS) % 3 == 0, 0, -0.05).double()
    posterior.gradient = pressed
    posterior.most = 400
    matrix = exact(curvature, posterior, jacobian)
    generator = generator_of(3, 0)
    scale = TEMPERATURE**0.5
    right = scale * sum(posterior.prior.root_noise(generator))
    right += scale * curvature.adjoint(posterior._disturbances(generator))
    change = posterior.sample(0).change
    slope = matrix @ change - right + pressed
    size = float((right - pressed).abs().max())
    is_free = change > posterior.low
    assert 0 < int(is_free.sum()) < CELLS
    assert bool((change >= posterior.low).all())
    assert float(slope[is_free].abs().max()) < 1e-3 * size
    assert float(slope[~is_free].min()) > -1e-3 * size


def test_conjugate_gradients_solve_and_count() -> None:
    root = random_values(9, 9)
    matrix, right = root @ root.T + torch.eye(9).double(), random_values(9, seed=1)
    solved = conjugate_gradients(lambda v: matrix @ v, lambda v: v / 3, right, 1e-10, 50)
    torch.testing.assert_close(matrix @ solved.value, right)
    torch.testing.assert_close(solved.lacking, torch.zeros_like(right), rtol=0, atol=1e-9)
    assert solved.products <= 12
    assert conjugate_gradients(lambda v: matrix @ v, lambda v: v, right, 1e-10, 3).products == 3
