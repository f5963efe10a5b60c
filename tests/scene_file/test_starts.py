"""Where parameters start: from the scene, a number, a color, a list or a file."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from example_scene import SCENE
from torch import Tensor

from ddrecon.io.volumes.table import write_field
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

Write = Callable[[str], Path]
BOUNDS = np.array([[-0.5, -0.75, -0.5], [0.5, 0.75, 0.5]])
SHAPE = (4, 3, 2)
COLORED = torch.tensor([1.0, 2, 3]).view(3, 1, 1, 1).expand(3, *SHAPE)


@pytest.fixture
def load(write: Write) -> Callable[[str], Scene]:
    return lambda parameters: load_scene(
        write(f"{SCENE}optimize: {{parameters: {parameters}}}\n"), dtype=torch.float64
    )


def expect(value: Tensor, wanted: object) -> None:
    wanted = torch.as_tensor(wanted, dtype=torch.float64)
    torch.testing.assert_close(value, wanted, rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("parameters", "name", "wanted"),
    [
        ("{density: {}}", "density", torch.full(SHAPE, 0.1)),
        ("{density: {init: 0.3}}", "density", torch.full(SHAPE, 0.3)),
        ("{density: {init: {constant: 0.3}}}", "density", torch.full(SHAPE, 0.3)),
        ("{density: {init: 0.3, field: false}}", "density", 0.3),
        ("{sigma_s: {}}", "sigma_s", [11.4, 10.8, 9.6]),
        ("{sigma_s: {init: 2}}", "sigma_s", [2, 2, 2]),
        ("{sigma_s: {init: [1, 2, 3], field: true}}", "sigma_s", COLORED),
        ("{sigma_t: {}}", "sigma_t", [12.0, 11.4, 10.2]),
        ("{albedo: {init: 0.5}}", "albedo", [0.5, 0.5, 0.5]),
        ("{g: {init: -0.5}}", "g", -0.5),
        ("{lights.0.irradiance: {}}", "lights.0.irradiance", [3.14159]),
        ("{lights.0.irradiance: {init: [1, 2, 3]}}", "lights.0.irradiance", [1, 2, 3]),
        ("{lights.0.direction: {init: [0, -1, 0]}}", "lights.0.direction", [0, -1, 0]),
        ("{views.front.camera: {}}", "views.front.camera", [0] * 6),
    ],
)
def test_a_start(load: Callable[[str], Scene], parameters: str, name: str, wanted: object) -> None:
    starts = load(parameters).starts
    assert list(starts) == [name]
    expect(starts[name], wanted)


@pytest.mark.parametrize(
    ("name", "colors"), [("density", None), ("sigma_a", None), ("sigma_a", 3), ("albedo", 3)]
)
def test_a_start_from_a_file(
    load: Callable[[str], Scene], tmp_path: Path, name: str, colors: int | None
) -> None:
    shape = (*SHAPE, colors) if colors else SHAPE
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    write_field(tmp_path / "start.npz", name, values, BOUNDS)
    start = load(f"{{{name}: {{init: {{file: start.npz}}}}}}").starts[name]
    by_color = values.transpose(3, 0, 1, 2) if colors else values[None]
    expect(start, values if name == "density" else by_color)
