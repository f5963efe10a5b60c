"""Every number of every light can be optimized: derivatives of whole images in both modes, and by
differences.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from media import half_empty, make_camera, make_scene
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.light.lights import (
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
)
from ddrecon.renderer import render
from ddrecon.scene import Scene

pytestmark = pytest.mark.slow


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def environment(has_sun: bool) -> EnvironmentLight:
    radiance = torch.rand(3, 6, 8, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    radiance[:, 1, 2] += 200 * has_sun
    return EnvironmentLight(radiance, tensor(1.3).squeeze(), tensor(20.0).squeeze(), directions=12)


LIGHTS: dict[str, Light] = {
    "directional": DirectionalLight(tensor(-2.0, -2.1, -1.0), tensor(3.0, 2.0, 1.0)),
    "ambient": AmbientLight(tensor(0.3, 0.4, 0.5)),
    "sky": environment(has_sun=False),
    "sky with a sun": environment(has_sun=True),
    "point outside": PointLight(tensor(0.3, 1.7, 1.1), tensor(3.0, 2.0, 1.0)),
    "point inside": PointLight(tensor(0.11, 0.13, 0.17), tensor(1.0)),
    "beam": BeamLight(
        tensor(0.1, 1.0, 0.05), tensor(-0.2, -1.0, -0.1), tensor(1.0, 2.0, 3.0), tensor(0.2)[0]
    ),
}
NUMBERS = [
    (light, field.name)
    for light, value in LIGHTS.items()
    for field in fields(value)
    if field.name not in ("directions", "up")
]
WAYS: dict[str, dict[str, Any]] = {
    "no model": {"g": 0.4, "model": "none"},
    "camera inside": {"g": -0.3, "view": {"eye": (0.1, 0.1, 0.2), "half_width": 0.8}},
}
each_number = pytest.mark.parametrize(("name", "number"), NUMBERS, ids=lambda value: str(value))
each_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS.keys())


@pytest.fixture
def build() -> Callable[[dict[str, Any]], Scene]:
    def make(way: dict[str, Any]) -> Scene:
        options = dict(way)
        return make_scene(
            half_empty(5, 4, 6, seed=7),
            camera=make_camera(size=(3, 4), **options.pop("view", {})),
            **options,
        )

    return make


def image_loss(scene: Scene, name: str, number: str) -> Callable[[Tensor], Tensor]:
    """A random weighted sum of the image of `scene` under one light, as a function of one of its
    numbers.
    """
    weight = torch.randn(
        3,
        *scene.views[0].camera.size,
        generator=torch.Generator().manual_seed(1),
        dtype=torch.float64,
    )
    return lambda value: (
        render(replace(scene, lights=[replace(LIGHTS[name], **{number: value})]))[0] * weight
    ).sum()


def shift_of(value: Tensor) -> Tensor:
    return torch.randn(value.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


@each_way
@each_number
def test_tangent_adjoint_and_differences_agree(name: str, number: str, way: dict[str, Any], build):
    """Along a random direction in the space of the number; errors relative to the size of the
    terms.
    """
    loss, value = image_loss(build(way), name, number), getattr(LIGHTS[name], number)
    shift, step = shift_of(value), 1e-5
    variable = value.clone().requires_grad_()
    terms = torch.autograd.grad(loss(variable), variable)[0] * shift
    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(loss(forward_ad.make_dual(value.clone(), shift))).tangent
    with torch.no_grad():
        difference = (loss(value + step * shift) - loss(value - step * shift)) / (2 * step)
    size = float(terms.abs().sum())
    assert abs(float(tangent - terms.sum())) < 1e-10 * size
    assert abs(float(difference - terms.sum())) < 1e-6 * size
