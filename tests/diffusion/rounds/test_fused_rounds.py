"""Rounds by fused kernels: the light and the derivatives of torch's."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from media import half_empty, make_scene, random_values
from torch import Tensor

from ddrecon.engine import use_engine
from ddrecon.medium.coefficients import Volume
from ddrecon.renderer import render

pytestmark = pytest.mark.slow
Sections = tuple[tuple[float, ...], ...]


def image_and_gradients(engine: str, g: float, sigma: Sections) -> list[Tensor]:
    """The image of a small scene lit in colors, and derivatives by its density, g and sun."""
    use_engine(engine)
    density = half_empty(7, 6, 5)
    scene = make_scene(density, directional=(3.0, 2.0, 1.0), ambient=(0.3,), transport_rounds=2)
    leaves = [density, density.new_tensor(g), scene.lights[0].direction]
    density, cosine, direction = (leaf.clone().requires_grad_() for leaf in leaves)
    sections = (density.new_tensor(section) for section in sigma)
    volume = Volume(scene.volume.grid, density, *sections, cosine)
    lights = [replace(scene.lights[0], direction=direction), *scene.lights[1:]]
    image = render(replace(scene, volume=volume, lights=lights))
    total = (image * random_values(*image.shape, seed=3)).sum()
    return [image.detach(), *torch.autograd.grad(total, [density, cosine, direction])]


@pytest.mark.parametrize("g", [0.0, 0.4, -0.6])
@pytest.mark.parametrize("sigma", [((0.5,), (8.0,)), ((0.5, 1.0, 2.0), (8.0, 6.0, 4.0))])
def test_rounds_of_both_engines_agree(g: float, sigma: Sections):
    both = (image_and_gradients(engine, g, sigma) for engine in ("warp", "torch"))
    for found, known in zip(*both, strict=True):
        torch.testing.assert_close(found, known, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("rounds", [1, 2])
def test_tangents_are_those_of_the_adjoint(rounds: int):
    use_engine("warp")
    density, change = half_empty(7, 6, 5), random_values(7, 6, 5, seed=5)
    scene = make_scene(density, directional=(3.0, 2.0, 1.0), transport_rounds=rounds)

    def image(density: Tensor) -> Tensor:
        sections = (density.new_tensor(section) for section in (0.5, 8.0, 0.4))
        return render(replace(scene, volume=Volume(scene.volume.grid, density, *sections)))

    shown, tangent = torch.func.jvp(image, (density,), (change,))
    weights = random_values(*shown.shape, seed=3)
    leaf = density.clone().requires_grad_()
    (gradient,) = torch.autograd.grad((image(leaf) * weights).sum(), leaf)
    torch.testing.assert_close(
        (tangent * weights).sum(), (gradient * change).sum(), rtol=1e-11, atol=0
    )
