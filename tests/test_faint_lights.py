"""Lights of a power of 1e-12 change nothing: whatever else there is, each thing counts once."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import pytest
import torch
from media import assert_near, box_grid, half_empty, make_camera, make_scene, random_values, tensor
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import (
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    Light,
    PointLight,
)
from ddrecon.light_field import fluence_of
from ddrecon.lighting import solve_light
from ddrecon.medium.phase import Blend, HenyeyGreenstein, Rayleigh
from ddrecon.picture import view_image
from ddrecon.scene import Scene

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_directions")]
SHAPE, FAINT = (3, 4, 3), 1e-12
MAP = half_empty(1, 4, 8, seed=3)
MAP[0, 1, 2] = 20.0  # a sun
EVERYWHERE: list[Light] = [
    DirectionalLight(tensor(1, -2, 0.5), tensor(FAINT, FAINT, FAINT)),
    AmbientLight(tensor(FAINT)),
    EnvironmentLight(FAINT * MAP, tensor(1)[0], tensor(20)[0], 4),
]
BEAM = BeamLight(tensor(2, 0.3, 0), tensor(-2, -0.2, 0.3), tensor(FAINT), tensor(0.3)[0])
LAMP = PointLight(tensor(0.4, 1.7, 0.2), tensor(FAINT))
GLOW = {"emission": tensor(0.5, 0.2, 0.1)}
BODY = {"black_body": random_values(3, *SHAPE, seed=1)}
WEIGHT = random_values(1, *SHAPE, seed=2)
BLENDED = {"phase": Blend(Rayleigh(tensor(0)), HenyeyGreenstein(tensor(0.5)[0]), WEIGHT)}
FINE = {"g": 0.7, "transport_rounds": 1, "degree": 3}
"""What a scene is, and what its volume is besides."""
FEATURES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "dark": ({"directional": None}, GLOW),
    "unscattered": ({"model": "none"}, GLOW),
    "unscattered, directed": ({"model": "none", "g": 0.6, "ambient": (0.3,)}, BODY),
    "only absorbed": ({"sigma_s": (0.0,)}, GLOW),
    "diffusion": ({"g": 0.5}, BODY),
    "support": ({}, GLOW | {"support": (half_empty(*SHAPE) > 0).double()}),
    "rounds": (FINE | {"ambient": (0.3,)}, BODY),
    "backward": (FINE | {"g": -0.7}, GLOW),
    "blended": (FINE, BODY | BLENDED),
    "refined": ({"refine": 3, "transport_rounds": 1}, GLOW),
    "flux limited": ({"model": "flux_limited"}, GLOW),
    "printed": ({"scheme": "printed", "sigma_s": (2.0,)}, GLOW),
    "index": (FINE, GLOW | {"index": 1.4}),
    "ground": ({"g": 0.4, "ground": True}, GLOW),
    "ground, unscattered": ({"model": "none", "ground": True}, GLOW),
    "periods": (FINE | {"periodic": (0, 2)}, BODY),
    "periods over a ground": ({"periodic": (0, 2), "ground": True, "ambient": (0.3,)}, GLOW),
    "periods, unscattered": ({"model": "none", "periodic": (0,)}, GLOW),
}


def scene_with(feature: str) -> Scene:
    more, volume = FEATURES[feature]
    more = {"camera": make_camera((0.5, 1.5, 2.5)), **more}
    grid = replace(box_grid(SHAPE), periodic=more.pop("periodic", ()))
    has_ground = more.pop("ground", False)
    scene = make_scene(0.1 + half_empty(*SHAPE), grid=grid, **more)
    ground = Ground(tensor(0.6), Plane(-0.7, 1)) if has_ground else None
    return replace(scene, volume=replace(scene.volume, **volume), ground=ground)


def faint_lights(scene: Scene) -> list[Light]:
    """All that there are in such a scene."""
    if scene.volume.grid.periodic:
        return EVERYWHERE
    return [*EVERYWHERE, BEAM, *([LAMP] if scene.volume.index == 1 else [])]


def seen_of(scene: Scene, *parts: str) -> list[Tensor]:
    """Fluence; and, of each of its `parts` of derivatives, image and slopes by density."""
    density = scene.volume.density.clone().requires_grad_()
    scene = replace(scene, volume=replace(scene.volume, density=density))
    light, (view,) = solve_light(scene, SolveMemory()), scene.views
    seen = [fluence_of(light, scene.diffusion).detach()]
    for derivatives in parts:
        image = view_image(light, scene, view.camera, derivatives)
        total = (image * half_empty(*image.shape, seed=4)).sum()
        (bar,) = torch.autograd.grad(total, density, retain_graph=True)
        seen += [image.detach(), bar]
    return seen


@functools.cache
def known_of(feature: str) -> list[Tensor]:
    return seen_of(scene_with(feature), "all", "single", "diffusion")


@pytest.mark.parametrize("feature", FEATURES)
def test_faint_lights_change_nothing(feature: str) -> None:
    scene = scene_with(feature)
    lit = seen_of(replace(scene, lights=[*scene.lights, *faint_lights(scene)]), "all")
    for found, known in zip(lit, known_of(feature), strict=False):
        assert_near(found, known, 1e-9)


@pytest.mark.parametrize("feature", FEATURES)
def test_halves_of_derivatives_sum_to_all_and_have_the_same_image(feature: str) -> None:
    _, image, bar, one, first_bar, other, second_bar = known_of(feature)
    assert_near(one, image, 1e-12)
    assert_near(other, image, 1e-12)
    assert_near(first_bar + second_bar, bar, 1e-12)
