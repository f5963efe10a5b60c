"""Tangents of whole renders by fused kernels: torch's, the transposes of adjoints, and slopes."""

from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.autograd.forward_ad as forward
from media import half_empty, make_camera, make_scene, random_values
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.light.lights import EnvironmentLight, PointLight
from ddrecon.picture import render_each
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import value_of, variable_names, with_values

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
pytestmark = pytest.mark.slow

SHAPE = (5, 6, 7)
CELLS = {"sigma_a": random_values(3, *SHAPE, seed=1), "sigma_s": random_values(3, *SHAPE, seed=2)}
GLOW = half_empty(3, *SHAPE, seed=4)
"""Emission, also in empty cells."""
GRAY = {"sigma_a": (1.0,), "sigma_s": (6.0,)}
CASES: dict[str, dict[str, Any]] = {
    "gray, parts": {**GRAY, "directional": (2.0,), "transport_rounds": 1, "receive": 3},
    "glowing": {"emission": GLOW, **GRAY, "transport_rounds": 2},
    "glowing alone": {"emission": GLOW[:1], "sigma_s": (0.5,), "directional": None},
    "forward, degree 1": {"g": 0.4, "degree": 1, "transport_rounds": 2},
    "forward, degree 3": {"g": 0.4, "degree": 3, "transport_rounds": 2, "closure": "smooth"},
    "backward, degree 3": {"g": -0.6, "degree": 3, "transport_rounds": 2, "ambient": (0.3,)},
    "backward, parts": {"g": -0.6, "transport_rounds": 2, "receive": 3},
    "cells": {"g": 0.3, "transport_rounds": 1, "ambient": (0.3,), "emission": GLOW[:1], **CELLS},
}
EVERY_LIGHT = "cells", "forward, degree 1"
"""Cases that have point lights and a sky besides."""
MOVES = "camera", "direction"
"""Ends of names of variables that move rays and beams."""


def scene_of(case: str, dtype: torch.dtype = torch.float64) -> Scene:
    """A scene whose density is 0 in half of its cells, seen through a lattice of rays."""
    settings = {
        name: part.to(dtype) if isinstance(part, Tensor) else part
        for name, part in CASES[case].items()
    }
    density = half_empty(*SHAPE, dtype=dtype)
    scene = make_scene(
        density, camera=make_camera((0.3, 0.4, 3.0), (9, 8), dtype=dtype), **settings
    )
    if case in EVERY_LIGHT:
        tensor = density.new_tensor
        scene.lights += [
            PointLight(tensor([0.9, 0.7, 0.2137]), tensor([1.0, 2.0, 0.5])),
            EnvironmentLight(
                random_values(3, 4, 8, seed=3, dtype=dtype), tensor(0.5), tensor(20.0), 6
            ),
        ]
    return replace(scene, render=RenderSettings(tolerance=1.0))


def variables_of(scene: Scene, moves: bool = False) -> dict[str, Tensor]:
    """All but those that others are made of; those that move rays and beams if it `moves`."""
    names = (name for name in variable_names(scene) if name not in ("sigma_t", "albedo"))
    return {
        name: value_of(scene, name).detach() for name in names if moves or not name.endswith(MOVES)
    }


def changes_of(values: dict[str, Tensor]) -> dict[str, Tensor]:
    """A change of each, of empty cells as well."""
    return {
        name: random_values(*value.shape, seed=seed).to(value) - 0.3
        for seed, (name, value) in enumerate(values.items(), 11)
    }


def image(scene: Scene, values: dict[str, Tensor], engine: str) -> Tensor:
    use_engine(engine)
    changed = with_values(scene, values)
    return render_each(changed, changed.views, SolveMemory())[0]


def tangent(
    scene: Scene, values: dict[str, Tensor], changes: dict[str, Tensor], engine: str
) -> Tensor:
    with forward.dual_level():
        duals = {n: forward.make_dual(value, changes[n]) for n, value in values.items()}
        return forward.unpack_dual(image(scene, duals, engine)).tangent


@pytest.mark.parametrize("case", CASES)
def test_tangents_of_both_engines_agree(case: str) -> None:
    scene = scene_of(case)
    values = variables_of(scene, moves=True)
    changes = changes_of(values)
    known, found = (tangent(scene, values, changes, engine) for engine in ("torch", "warp"))
    assert float((found - known).norm()) <= 1e-11 * float(known.norm())


def test_tangents_agree_in_single_precision() -> None:
    case = "forward, degree 3"
    exact, scene = scene_of(case), scene_of(case, torch.float32)
    values = variables_of(exact)
    changes = changes_of(values)
    known = tangent(exact, values, changes, "torch")
    single = ({n: each.float() for n, each in tensors.items()} for tensors in (values, changes))
    found = tangent(scene, *single, "warp")
    assert float((found - known).norm()) <= 1e-5 * float(known.norm())


@pytest.mark.parametrize("case", CASES)
def test_tangents_are_transposes_of_adjoints_and_slopes(case: str) -> None:
    scene = scene_of(case)
    values = variables_of(scene)
    changes = changes_of(values)
    along = tangent(scene, values, changes, "warp")
    weight = random_values(*along.shape, seed=3)
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    bars = torch.autograd.grad((image(scene, leaves, "warp") * weight).sum(), [*leaves.values()])
    back = sum(float((bar * changes[n]).sum()) for n, bar in zip(leaves, bars, strict=True))
    assert float((along * weight).sum()) == pytest.approx(back, rel=1e-10)
    # Cells that are empty become negative on one side: there it is the same polynomial.
    ends = (
        image(scene, {n: value + step * changes[n] for n, value in values.items()}, "warp")
        for step in (1e-5, -1e-5)
    )
    slope = torch.sub(*ends) / 2e-5
    assert float((slope - along).norm()) <= 1e-6 * float(along.norm())


@pytest.mark.parametrize("name", ["density", "g"])
def test_torch_func_finds_the_same_tangents(name: str) -> None:
    scene = scene_of("forward, degree 1")
    value = value_of(scene, name).detach()
    change = random_values(*value.shape, seed=5)
    known = tangent(scene, {name: value}, {name: change}, "warp")
    by_func = torch.func.jvp(lambda each: image(scene, {name: each}, "warp"), (value,), (change,))
    torch.testing.assert_close(by_func[1], known, rtol=1e-12, atol=0)


@pytest.mark.parametrize("engine", ENGINES)
def test_gradients_are_those_of_the_pass_that_was_made(engine: str) -> None:
    """Value, tangent and gradient may come of one pass, and another engine be chosen after it."""
    scene, change = scene_of("backward, degree 3"), random_values(*SHAPE, seed=5)
    leaf = scene.volume.density.clone().requires_grad_()

    def gradient(seen: Tensor) -> Tensor:
        return torch.autograd.grad(seen.sum(), leaf)[0]

    before, other = (image(scene, {"density": leaf}, engine) for _ in range(2))
    known = gradient(image(scene, {"density": leaf}, engine))
    with forward.dual_level():
        beside = image(scene, {"density": leaf}, engine)
        dual = image(scene, {"density": forward.make_dual(leaf, change)}, engine)
        seen, along = forward.unpack_dual(dual)
        found = [gradient(before), gradient(beside)]
    found.append(gradient(seen))
    use_engine("torch" if engine == "warp" else "warp")
    for one in (*found, gradient(other)):
        torch.testing.assert_close(one, known, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(along.sum(), (known * change).sum(), rtol=1e-10, atol=0)
