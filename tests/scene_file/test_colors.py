"""Equal colors are one channel of light, but for those that are optimized."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from example_scene import SCENE, changed

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.lighting import solve_light
from ddrecon.picture import render
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import value_of, with_values

Write = Callable[[str], Path]
TREE = yaml.safe_load(SCENE)
COLORS = {
    "sigma_a": 0.6,
    "sigma_s": 9.0,
    "phase.weight": 0.3,
    "lights.0.irradiance": 3.1,
    "lights.1.radiance": 0.3,
    "lights.2.intensity": 1.5,
}


def scene_text(**more: Any) -> str:
    """A scene whose colors are all three times those of `COLORS`."""
    three = {name: [value] * 3 for name, value in COLORS.items()}
    phase = {"type": "two_lobe", "g": [0.5, -0.3], "weight": three["phase.weight"]}
    sections = {name: three[name] for name in ("sigma_a", "sigma_s")}
    lights = [
        TREE["lights"][0] | {"irradiance": three["lights.0.irradiance"]},
        {"type": "ambient", "radiance": three["lights.1.radiance"]},
        {"type": "point", "position": [1, 2, 1], "intensity": three["lights.2.intensity"]},
        {"type": "environment", "file": "sky.npy", "directions": 6},
    ]
    volume = {name: value for name, value in TREE["volume"].items() if name != "g"}
    return changed(
        volume=volume | sections | {"phase": phase},
        lights=lights,
        views=[TREE["views"][0] | {"background": [0.2, 0.2, 0.2]}],
        **more,
    )


@pytest.fixture(autouse=True)
def gray_sky(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).random((4, 8, 1)).astype(np.float32)
    np.save(tmp_path / "sky.npy", pixels.repeat(3, 2))


def test_equal_colors_are_one_channel_and_give_the_same_image(write: Write):
    scene = load_scene(write(scene_text()), dtype=torch.float64)
    names = [*COLORS, "lights.3.radiance"]
    gray = {name: value_of(scene, name) for name in names}
    light = solve_light(scene, SolveMemory())
    assert len(light.diffuse[0]) == 1 and all(gray[name].numel() == 1 for name in COLORS)
    three = {name: torch.cat([torch.atleast_1d(one)] * 3) for name, one in gray.items()}
    colored = with_values(scene, three)
    assert len(solve_light(colored, SolveMemory()).diffuse[0]) == 3
    torch.testing.assert_close(render(scene), render(colored), rtol=1e-10, atol=0)


@pytest.mark.parametrize("name", [*COLORS, "sigma_t", "lights.3.radiance"])
def test_what_is_optimized_by_color_keeps_its_three(write: Write, name: str):
    path = write(scene_text(optimize={"parameters": {name: {}}}))
    kept = value_of(load_scene(path), name)
    assert kept.shape[0] == 3
    other = "lights.0.irradiance" if name != "lights.0.irradiance" else "lights.1.radiance"
    assert value_of(load_scene(path), other).shape == (1,)
