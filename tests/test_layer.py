"""The renderer as a layer: a network trains through it, and torch's function transforms see the
same derivatives.
"""

from __future__ import annotations

import pytest
import torch
from media import box_grid, make_scene, random_values
from torch import Tensor

from ddrecon.layer import VolumeRenderer
from ddrecon.renderer import render
from ddrecon.variables.values import value_of, with_values

SHAPE = (5, 4, 6)


def test_a_tiny_network_learns_the_density_behind_an_image() -> None:
    torch.manual_seed(0)
    grid = box_grid(SHAPE)
    z, y, x = torch.broadcast_tensors(*grid.centers(torch.zeros(())))
    truth = torch.nn.functional.softplus(3 * x - 2 * y + z)
    layer = VolumeRenderer(make_scene(truth, ambient=(0.2,), tolerance=1e-5))
    target = layer(density=truth)
    network = torch.nn.Sequential(
        torch.nn.Linear(3, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1), torch.nn.Softplus()
    )
    optimizer = torch.optim.Adam(network.parameters(), lr=0.05)
    losses = []
    for _ in range(120):
        density = network(torch.stack([x, y, z], -1))[..., 0]
        loss = (layer(density=density) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert all(
        parameter.grad is not None and bool(torch.isfinite(parameter.grad).all())
        for parameter in network.parameters()
    )
    assert losses[-1] < 0.02 * losses[0]


def test_anything_by_name_replaces_what_the_scene_has() -> None:
    scene = make_scene(random_values(*SHAPE), ambient=(0.2,))
    brighter = {
        "lights.0.irradiance": 2 * value_of(scene, "lights.0.irradiance"),
        "lights.1.radiance": 2 * value_of(scene, "lights.1.radiance"),
    }
    torch.testing.assert_close(
        VolumeRenderer(scene)(values=brighter), 2 * render(scene), rtol=1e-10, atol=1e-14
    )


NAMES = [
    "density",
    "sigma_a",
    "sigma_s",
    "g",
    "lights.0.irradiance",
    "lights.0.direction",
    "lights.1.radiance",
    "views.view.camera",
]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", NAMES)
def test_function_transforms_agree_with_backward(name: str, dtype: torch.dtype) -> None:
    scene = make_scene(
        random_values(*SHAPE, dtype=dtype),
        g=0.3,
        ambient=(0.2,),
        tolerance=1e-13 if dtype == torch.float64 else 1e-6,
    )
    value = value_of(scene, name)
    change = random_values(*value.shape, seed=1, dtype=dtype) - 0.5

    def image(moved: Tensor) -> Tensor:
        return render(with_values(scene, {name: moved}))

    out, tangent = torch.func.jvp(image, (value,), (change,))
    weight = random_values(*out.shape, seed=2, dtype=dtype)
    leaf = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad((image(leaf) * weight).sum(), leaf)
    one, other = (tangent * weight).sum(), (gradient * change).sum()
    assert abs(one - other) <= (1e-10 if dtype == torch.float64 else 1e-3) * max(
        abs(one), abs((tangent * weight).abs().sum()) * 1e-2
    )
