"""Derivative images equal central differences of the image, and what closed forms say."""

import pytest
import torch
from media import make_scene, random_values, render_tangent
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import UsageError
from ddrecon.lighting import solve_light
from ddrecon.picture import render, view_components
from ddrecon.scene import Scene
from ddrecon.variables.values import value_of, variation, with_values

STEP = 1e-5


@pytest.fixture
def scene() -> Scene:
    return make_scene(random_values(4, 3, 5), g=0.3, ambient=(0.2, 0.3, 0.4))


def images_of(scene: Scene) -> dict[str, Tensor]:
    parts = view_components(solve_light(scene, SolveMemory()), scene, scene.views[0].camera)
    return {"image": render(scene)[0], **vars(parts)}


@pytest.mark.slow
def test_a_derivative_image_is_the_central_difference_of_the_image(scene: Scene) -> None:
    """Of the image and of each of its parts, by one component."""
    name = "albedo.b"
    variable, change = variation(scene, name)
    assert variable == "albedo" and change.tolist() == [0.0, 0.0, 1.0]
    images, value = render_tangent(scene, name, images_of), value_of(scene, variable)
    high, low = (
        images_of(with_values(scene, {variable: value + step * change})) for step in (STEP, -STEP)
    )
    as_it_is = images_of(scene)
    for key, (image, derivative) in images.items():
        difference = (high[key] - low[key]) / (2 * STEP)
        size = max(1e-2, float(difference.abs().max()))
        assert (derivative - difference).abs().max() <= 1e-6 * size, key
        torch.testing.assert_close(image, as_it_is[key], rtol=1e-11, atol=0)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("depth", "no variable 'depth'"),
        ("lights.0.direction", "lights.0.direction.x"),
        ("views.view.camera", "rotation_x"),
        ("sigma_s.x", "no variable"),
    ],
)
def test_what_cannot_vary_is_refused_with_what_can(scene: Scene, name: str, hint: str) -> None:
    with pytest.raises(UsageError, match=hint):
        variation(scene, name)
