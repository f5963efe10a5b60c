"""What pictures say of single numbers, against products with the whole matrix."""

from dataclasses import replace

import pytest
import torch
from media import data_product, make_camera, make_scene, random_values

from ddrecon.losses import Target
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.numbers import Point, find_matrix, single_numbers
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import View
from ddrecon.settings import ParameterSettings
from ddrecon.uncertainty.curvature import Curvature
from ddrecon.variables.values import value_of

NAMES = "lights.0.irradiance", "density", "g", "views.one.camera"
NAMES += "views.two.exposure", "views.two.offset"


@pytest.fixture(scope="module")
def curvature() -> Curvature:
    """Two views, of which one moves its camera and the other is exposed, in light of one number."""
    density = 0.3 + random_values(3, 3, 3)
    base = make_scene(density, g=0.3, ambient=(0.2, 0.3, 0.4), transport_rounds=0)
    images = random_values(2, 3, 4, 5, seed=2)
    one = View("one", make_camera((0.2, 0.3, 2.5)), images[0])
    two = View("two", make_camera((2.4, -0.3, 0.5)), images[1], weight=2.0)
    two = replace(two, exposure=density.new_tensor([1.1, 1.2, 0.9]), offset=density.new_zeros(1))
    scene = replace(base, views=[one, two])
    parameters = [
        Parameter(name, ParameterSettings(), value_of(scene, name), scene.volume.grid)
        for name in NAMES
    ]
    # Twists are about cameras as they were told: the derivative is where it has moved to.
    parameters[3].value = 0.02 * random_values(6, seed=3)
    targets = {view.name: Target.of(view.image, None) for view in scene.views}
    return Curvature(scene, parameters, targets)


def test_it_is_the_part_of_the_matrix_between_numbers(
    curvature: Curvature, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By differences: to first order in how long these are."""
    numbers = single_numbers(curvature.parameters)
    assert [number.name for number in numbers] == [name for name in NAMES if name != "density"]
    ways = [
        curvature.join({p.name: entry})
        for p in numbers
        for entry in torch.eye(p.value.numel()).double().view(-1, *p.value.shape)
    ]
    basis = torch.stack(ways, 1)
    wanted = basis.T @ torch.stack([data_product(curvature, way) for way in ways], 1)
    size = wanted.diagonal().sqrt()
    point = Point(curvature.scene, curvature.values, curvature.weights, curvature.solutions)
    monkeypatch.setattr(tuning, "CLOSE", 1e-10)
    errors = []
    for apart in (1e-3, 2e-3):
        monkeypatch.setattr(tuning, "APART", apart)
        errors.append((find_matrix(point, numbers) - wanted) / size / size[:, None])
    torch.testing.assert_close(errors[1], 2 * errors[0], rtol=0, atol=1e-5)
    assert errors[0].abs().max() < 1e-3
