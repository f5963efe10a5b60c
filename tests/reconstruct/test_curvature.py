"""Products with J^T W J against the matrix itself, column by column."""

from dataclasses import replace

import pytest
import torch
from media import data_product, half_empty, make_camera, make_scene, random_values
from torch import Tensor

from ddrecon.losses import LOSSES, Target
from ddrecon.picture import render
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import Scene, View
from ddrecon.settings import ParameterSettings
from ddrecon.uncertainty.curvature import Curvature
from ddrecon.variables.values import value_of, with_values

SHAPE = (3, 3, 3)
NAMES = ("density", "g", "lights.0.irradiance", "views.one.camera", "views.two.exposure")


def small_scene(dtype: torch.dtype, rounds: int = 1) -> Scene:
    density = half_empty(*SHAPE, dtype=dtype)
    base = make_scene(density, g=0.3, ambient=(0.2, 0.3, 0.4), transport_rounds=rounds)
    eyes = {"one": (0.2, 0.3, 2.5), "two": (2.4, -0.3, 0.5)}
    views = [
        View(name, make_camera(eye, dtype=dtype), random_values(3, 4, 5, seed=2, dtype=dtype))
        for name, eye in eyes.items()
    ]
    views[1] = replace(views[1], weight=2.0, mask=random_values(4, 5, seed=4, dtype=dtype).round())
    return replace(base, views=views)


def curvature_of(scene: Scene, loss: str = "l2") -> Curvature:
    parameters = [
        Parameter(name, ParameterSettings(), value_of(scene, name), scene.volume.grid)
        for name in NAMES
    ]
    targets = {view.name: Target.of(view.image, view.mask, loss) for view in scene.views}
    return Curvature(scene, parameters, targets)


def differences(scene: Scene, curvature: Curvature, ways: Tensor) -> Tensor:
    """J times each of `ways` [ways, parameters], as rows, by central differences."""
    base, step = curvature.join(curvature.values), 1e-4

    def pictures(vector: Tensor) -> Tensor:
        world = with_values(scene, curvature.split(vector))
        return render(world).flatten()

    return torch.stack(
        [(pictures(base + step * way) - pictures(base - step * way)) / (2 * step) for way in ways]
    )


def test_a_product_is_that_with_the_matrix_of_differences() -> None:
    # Inside, where no entry has a kink: a cell at 0 cannot go below.
    scene = small_scene(torch.float64, rounds=0)
    scene = with_values(scene, {"density": scene.volume.density + 0.1})
    curvature = curvature_of(scene)
    # Every parameter by itself (one cell of the density), and all at once.
    ways = random_values(6, curvature.size) - 0.5
    ways[0] = torch.eye(curvature.size)[13]
    for way, name in zip(ways[1:5], NAMES[1:], strict=True):
        part = {name: curvature.split(way)[name]}
        way.copy_(curvature.join(part))
    changes = differences(scene, curvature, ways)
    weights = torch.cat([curvature.weights[v.name].expand(3, 4, 5).flatten() for v in scene.views])
    found = torch.stack([data_product(curvature, way) for way in ways]) @ ways.T
    wanted = (changes * weights) @ changes.T
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6 * float(wanted.abs().max()))


@pytest.mark.parametrize("loss", LOSSES)
def test_weights_are_the_second_derivative_of_the_loss_or_of_a_parabola_above_it(loss: str) -> None:
    target = Target.of(0.8 * random_values(3, 4, 5), random_values(4, 5, seed=1).round(), loss)
    image = target.image + 0.4 * (random_values(3, 4, 5, seed=3) - 0.5)
    weights = target.weights_at(image)
    image = image.requires_grad_()
    (slope,) = torch.autograd.grad(target.loss_of(image), image)
    torch.testing.assert_close(slope, weights * (image.detach() - target.image))
    for part in (0.0, 0.5, 1.5, -2.0):
        other = target.image + part * (image.detach() - target.image)
        parabola = (weights * ((other - target.image) ** 2 - (image - target.image) ** 2)).sum() / 2
        assert target.loss_of(other) <= target.loss_of(image) + parabola + 1e-12


def test_products_are_those_of_a_symmetric_matrix() -> None:
    """Also with a transport round."""
    curvature = curvature_of(small_scene(torch.float64))
    one, other = random_values(2, curvature.size)
    products = data_product(curvature, one), data_product(curvature, other)
    assert float(other @ products[0]) == pytest.approx(float(one @ products[1]), rel=1e-9)
    assert float(one @ products[0]) > 0
