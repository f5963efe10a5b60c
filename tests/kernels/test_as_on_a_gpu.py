"""What kernels compute does not depend on whether an item is a cell, nor on the order of items."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from media import half_empty, make_camera, make_scene, random_values
from twins import assert_same, differentiate, images_of, values_of

from ddrecon.light.lights import EnvironmentLight, PointLight
from ddrecon.medium.phase_blend import TwoLobe
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings
from ddrecon.variables.values import variable_names

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from as_on_a_gpu import ORDERS, as_on_a_gpu, headers_of

from ddrecon.kernels.text import TextKernel

SHAPE = (5, 6, 7)
PACKAGE = Path(__file__).parents[2] / "ddrecon"
MOVES = "camera", "focal", "principal_point", "direction", "position"
"""Ends of names of variables that move rays, beams and lamps."""


def smoke() -> Scene:
    """Gray, with support and two lights."""
    density = half_empty(*SHAPE)
    scene = make_scene(
        density, sigma_a=(1.0,), sigma_s=(6.0,), g=0.5, directional=(2.0,), transport_rounds=1
    )
    scene.lights.append(
        PointLight(density.new_tensor([0.1, 0.05, -0.1]), density.new_tensor([1.0]))
    )
    return replace(scene, volume=replace(scene.volume, support=(density > 0).to(density)))


def cloud() -> Scene:
    """In color, under a sky, seen from inside."""
    camera = make_camera((0.1, 0.12, 0.05), (9, 10), half_width=0.6)
    rounds = {"degree": 3, "transport_rounds": 2, "closure": "smooth"}
    scene = make_scene(half_empty(*SHAPE), g=0.4, camera=camera, **rounds)
    sky = EnvironmentLight(random_values(3, 4, 8, seed=3), *random_values(2, seed=4), 6)
    scene.lights.append(sky)
    return scene


def mixture() -> Scene:
    """Everything differs from cell to cell; two samples of a ray in a cell."""
    fields = {
        name: random_values(3, *SHAPE, seed=seed)
        for seed, name in enumerate(("sigma_a", "sigma_s", "emission"), 1)
    }
    camera = make_camera((0.3, 0.4, 3.0), (9, 8))
    scene = make_scene(
        half_empty(*SHAPE), transport_rounds=1, ambient=(0.3,), camera=camera, **fields
    )
    lobes = torch.tensor([0.6, -0.4], dtype=torch.float64)
    scene.volume.phase = TwoLobe(lobes, random_values(*SHAPE, seed=5))
    lamp = PointLight(random_values(3, seed=6) + 0.5, random_values(3, seed=7))
    scene.lights.append(lamp)
    return replace(scene, render=RenderSettings(steps_per_voxel=2))


def variables_of(scene: Scene, moves: bool) -> list[str]:
    """All but those that others are made of; with `MOVES` if it `moves`."""
    names = (name for name in variable_names(scene) if name not in ("sigma_t", "albedo"))
    return [name for name in names if moves or not name.endswith(MOVES)]


@pytest.mark.slow
def test_every_kernel_finds_the_same_in_any_order() -> None:
    headers: set[str] = set()
    for scene, moves in ((smoke(), False), (cloud(), True), (mixture(), True)):
        case = images_of(scene), values_of(scene, variables_of(scene, moves)), True
        known = differentiate("torch", *case)
        for order in ORDERS:
            with as_on_a_gpu(order) as launched:
                found = differentiate("warp", *case)
            assert_same(found, known, 1e-12)
            headers |= headers_of(launched)
    assert {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.h")} <= headers


def test_an_item_that_reads_what_another_writes_is_seen() -> None:
    text = "sums[item] = field[item] + (item ? sums[item - 1] : 0);"
    kernel = TextKernel("race", 64, text, "F *field, *sums", "sums")
    field, found = torch.ones(9, dtype=torch.float64), []
    for order in ORDERS:
        sums = torch.zeros_like(field)
        with as_on_a_gpu(order):
            kernel.launch(len(field), {"field": field}, {"sums": sums})
        found.append(float(sums.sum()))
    assert len(set(found)) == len(ORDERS)
