"""Both engines compute the same images, gradients and tangents, of all kinds of scenes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from media import half_empty, make_camera, make_scene, random_values
from scenes import lamp, sky
from torch.autograd import forward_ad as forward
from twins import (
    assert_render_twins,
    assert_transposes,
    change_of,
    differentiate,
    images_of,
    values_of,
)

from ddrecon.engine import ENGINES, use_engine
from ddrecon.layer import VolumeRenderer
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import variable_names

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_directions")]

ROOT = Path(__file__).parents[1]
ALIKE = ("film", "noisy", "plume", "satellite", "fig06_light", "fig07", "fig08", "fig09")
ALIKE += ("fig12_single", "fig13", "fire", "ground", "cloud")
"""Configs whose lights, media and settings are of the kinds of others."""
CONFIGS = sorted(one for one in (ROOT / "configs").rglob("*.yaml") if one.stem not in ALIKE)
MOST_CELLS = 8


def variables_of(scene):
    """All but those that others are made of."""
    return [name for name in variable_names(scene) if name not in ("sigma_t", "albedo")]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda path: path.stem)
def test_engines_agree_on_every_kind_of_config(config):
    scene = load_scene(config, dtype=torch.float64)
    factor = -(-max(scene.volume.grid.shape) // MOST_CELLS)
    scene = scene_at_level(replace(scene, views=scene.views[:2]), factor)
    volume = replace(scene.volume, density=half_empty(*scene.volume.grid.shape))
    diffusion = replace(scene.diffusion, tolerance=1e-14)
    scene = replace(scene, volume=volume, diffusion=diffusion)
    assert_render_twins(scene, variables_of(scene))


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
    "flux limited": {"model": "flux_limited", "g": 0.4, "ambient": (0.3,)},
    "black": {"sigma_s": (0.0,), "model": "none", "ambient": (0.3,)},
    "cells": {"g": 0.3, "transport_rounds": 1, "ambient": (0.3,), "emission": GLOW[:1], **CELLS},
}
MOVES = "camera", "direction"
"""Ends of names of variables that move rays and beams."""
EVERY_LIGHT = "cells", "forward, degree 1", "black"
"""Cases that have point lights and a sky besides."""


def scene_of(case):
    """A scene whose density is 0 in half of its cells, seen through a lattice of rays."""
    camera = make_camera((0.3, 0.4, 3.0), (9, 8))
    scene = make_scene(half_empty(*SHAPE), camera=camera, **CASES[case])
    if case in EVERY_LIGHT:
        scene.lights += [lamp(), sky()]
    return replace(scene, render=RenderSettings(tolerance=1.0))


@pytest.mark.parametrize("case", CASES)
def test_engines_have_the_same_tangents_and_gradients(case):
    scene = scene_of(case)
    assert_render_twins(scene, variables_of(scene), has_tangent=True)


@pytest.mark.parametrize("engine", ENGINES)
def test_single_precision_is_close_to_double(engine):
    scene = scene_of("forward, degree 3")
    values = values_of(scene, [n for n in variables_of(scene) if not n.endswith(MOVES)])
    single = {name: value.float() for name, value in values.items()}
    known = differentiate("torch", images_of(scene), values, has_tangent=True)
    rounded = VolumeRenderer(scene).to(torch.float32).scene
    rounded.diffusion = replace(rounded.diffusion, tolerance=1e-6)
    found = differentiate(engine, images_of(rounded), single, has_tangent=True)
    for name, value in known.items():
        assert float((found[name] - value).norm()) <= 1e-4 * float(value.norm()), name


@pytest.mark.parametrize("case", CASES)
def test_tangents_are_transposes_of_adjoints_and_slopes(case):
    scene = scene_of(case)
    values = values_of(scene, [n for n in variables_of(scene) if not n.endswith(MOVES)])
    changes, show = {n: change_of(value, n) for n, value in values.items()}, images_of(scene)
    found = differentiate("warp", show, values, has_tangent=True)
    assert_transposes(found, values)
    # Cells that are empty become negative on one side: there it is the same polynomial.
    ends = (
        show({name: value + step * changes[name] for name, value in values.items()})[0]
        for step in (1e-5, -1e-5)
    )
    slope, along = torch.sub(*ends) / 2e-5, found["tangent 0"]
    assert float((slope - along).norm()) <= 1e-6 * float(along.norm())


@pytest.mark.parametrize("engine", ENGINES)
def test_gradients_are_those_of_the_pass_that_was_made(engine):
    """Value, tangent and gradient may come of one pass, and another engine be chosen after it."""
    use_engine(engine)
    scene, change = scene_of("backward, degree 3"), random_values(*SHAPE, seed=5)
    leaf = scene.volume.density.clone().requires_grad_()
    show = images_of(scene)

    def gradient(seen):
        return torch.autograd.grad(seen.sum(), leaf)[0]

    before, other = (show({"density": leaf})[0] for _ in range(2))
    known = gradient(show({"density": leaf})[0])
    with forward.dual_level():
        beside = show({"density": leaf})[0]
        dual = show({"density": forward.make_dual(leaf, change)})[0]
        seen, along = forward.unpack_dual(dual)
        found = [gradient(before), gradient(beside)]
    found.append(gradient(seen))
    use_engine("torch" if engine == "warp" else "warp")
    for one in (*found, gradient(other)):
        torch.testing.assert_close(one, known, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(along.sum(), (known * change).sum(), rtol=1e-10, atol=0)
