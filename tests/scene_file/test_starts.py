"""Where parameters start: from the scene, a number, a color, a list or a file, as fields or single
values; and what is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from example_scene import SCENE
from torch import Tensor

from ddrecon.errors import SceneError
from ddrecon.io.volumes.table import write_field
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

Write = Callable[[str], Path]
BOUNDS = np.array([[-0.5, -0.75, -0.5], [0.5, 0.75, 0.5]])
SHAPE = (4, 3, 2)


@pytest.fixture
def load(write: Write) -> Callable[[str], Scene]:
    return lambda parameters: load_scene(
        write(f"{SCENE}optimize: {{parameters: {parameters}}}\n"), dtype=torch.float64
    )


@pytest.fixture
def refused(write: Write, tmp_path: Path) -> Callable[[str], list[str]]:
    def problems(parameters: str) -> list[str]:
        with pytest.raises(SceneError) as caught:
            load_scene(write(f"{SCENE}optimize: {{parameters: {parameters}}}\n"))
        return [line.replace(f"{tmp_path}/", "") for line in caught.value.problems]

    return problems


def expect(value: Tensor, wanted: object) -> None:
    torch.testing.assert_close(
        value, torch.as_tensor(wanted, dtype=torch.float64), rtol=1e-6, atol=0
    )


@pytest.mark.parametrize(
    ("parameters", "name", "wanted"),
    [
        ("{density: {}}", "density", torch.full(SHAPE, 0.1)),
        ("{density: {init: 0.3}}", "density", torch.full(SHAPE, 0.3)),
        ("{density: {init: {constant: 0.3}}}", "density", torch.full(SHAPE, 0.3)),
        ("{density: {init: 0.3, field: false}}", "density", 0.3),
        ("{sigma_s: {}}", "sigma_s", [11.4, 10.8, 9.6]),
        ("{sigma_s: {init: 2}}", "sigma_s", [2, 2, 2]),
        (
            "{sigma_s: {init: [1, 2, 3], field: true}}",
            "sigma_s",
            torch.tensor([1.0, 2, 3]).view(3, 1, 1, 1).expand(3, *SHAPE),
        ),
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
    values = (
        np.random.default_rng(0).random((*SHAPE, colors) if colors else SHAPE).astype(np.float32)
    )
    write_field(tmp_path / "start.npz", name, values, BOUNDS)
    start = load(f"{{{name}: {{init: {{file: start.npz}}}}}}").starts[name]
    expect(
        start,
        values if name == "density" else values.transpose(3, 0, 1, 2) if colors else values[None],
    )


@pytest.mark.parametrize(
    ("parameters", "problem"),
    [
        ("{densty: {}}", "optimize.parameters.densty: unknown parameter; did you mean 'density'?"),
        (
            "{lights.7.irradiance: {}}",
            "optimize.parameters.lights.7.irradiance: the scene has no such number; did you mean"
            " 'lights.0.irradiance'?",
        ),
        (
            "{lights.0.radiance: {}}",
            "optimize.parameters.lights.0.radiance: the scene has no such number",
        ),
        (
            "{views.back.camera: {}}",
            "optimize.parameters.views.back.camera: the scene has no such number; did you mean"
            " 'views.front.camera'?",
        ),
        (
            "{albedo: {init: 1.5}}",
            "optimize.parameters.albedo.init: must be at least 0 and at most 1, found 1.5",
        ),
        (
            "{g: {max: 1}}",
            "optimize.parameters.g.max: must be at least -0.99 and at most 0.99, found 1",
        ),
        (
            "{sigma_s: {init: [1, 2]}}",
            "optimize.parameters.sigma_s.init: expected one number or [r, g, b], found a list of 2",
        ),
        (
            "{lights.0.direction: {init: 3}}",
            "optimize.parameters.lights.0.direction.init: expected a list of 3 numbers",
        ),
        (
            "{lights.0.irradiance: {field: true}}",
            "optimize.parameters.lights.0.irradiance.field: it is not a field, so it has none",
        ),
        (
            "{lights.1.radiance: {tv: 1}}",
            "optimize.parameters.lights.1.radiance.tv: it is not a field, so it has none",
        ),
        (
            "{albedo: {}, sigma_s: {}}",
            "optimize.parameters.albedo: cannot be optimized beside sigma_s",
        ),
        (
            "{lights.0.irradiance: {init: {file: scene.yaml}}}",
            "optimize.parameters.lights.0.irradiance.init.file: lights.0.irradiance is not a field",
        ),
    ],
)
def test_what_is_refused(
    refused: Callable[[str], list[str]], parameters: str, problem: str
) -> None:
    (line,) = refused(parameters)
    assert line.startswith("scene.yaml:13:") and problem in line


def test_a_file_of_another_size_is_refused(
    refused: Callable[[str], list[str]], tmp_path: Path
) -> None:
    write_field(tmp_path / "start.npz", "sigma_a", np.ones((2, 2, 2)), BOUNDS)
    (line,) = refused("{sigma_a: {init: {file: start.npz}}}")
    assert (
        "optimize.parameters.sigma_a.init.file: has [2, 2, 2] cells [z, y, x], but the volume"
        " has [4, 3, 2]" in line
    )


def test_a_field_is_not_made_one_number_in_silence(
    refused: Callable[[str], list[str]], tmp_path: Path
) -> None:
    write_field(tmp_path / "start.npz", "sigma_a", np.random.default_rng(0).random(SHAPE), BOUNDS)
    (line,) = refused("{sigma_a: {init: {file: start.npz}, field: false}}")
    assert (
        "optimize.parameters.sigma_a: differs from cell to cell where it starts; give init: number"
        in line
    )
