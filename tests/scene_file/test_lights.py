"""Environment maps and point lights in scene files: their tensors, their defaults, and maps that
cannot be used.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from example_scene import changed

from ddrecon.errors import DataWarning, FormatError, SceneError
from ddrecon.light.lights import EnvironmentLight, PointLight
from ddrecon.scene_file.build import load_scene
from ddrecon.scene_file.dump import dump_scene
from ddrecon.scene_file.load import read_scene
from ddrecon.scene_file.schema import EnvironmentSection, PointSection

Write = Callable[[str], Path]


def lit_by(*lights: dict[str, Any]) -> str:
    return changed(lights=list(lights))


def save_map(folder: Path, *shape: int) -> np.ndarray:
    pixels = np.random.default_rng(0).random(shape).astype(np.float32)
    np.save(folder / "sky.npy", pixels)
    return pixels


def test_a_map_keeps_its_pixels_and_has_defaults(write: Write, tmp_path: Path):
    pixels = save_map(tmp_path, 4, 6, 3)
    (light,) = load_scene(write(lit_by({"type": "environment", "file": "sky.npy"}))).lights
    assert isinstance(light, EnvironmentLight) and np.array_equal(
        light.radiance, pixels.transpose(2, 0, 1)
    )
    assert (
        light.scale.item() == 1
        and light.rotation.item() == 0
        and light.scale.ndim == light.rotation.ndim == 0
        and light.directions == 48
    )


def test_a_map_is_scaled_and_turned(write: Write, tmp_path: Path):
    save_map(tmp_path, 4, 6, 3)
    entry = {
        "type": "environment",
        "file": "sky.npy",
        "scale": 2.5,
        "rotation": -370,
        "directions": 12,
        "up": "z",
    }
    (light,) = load_scene(write(lit_by(entry)), dtype=torch.float64).lights
    assert isinstance(light, EnvironmentLight) and (
        light.scale.item(),
        light.rotation.item(),
        light.directions,
        light.up,
    ) == (2.5, -370, 12, "z")
    assert {value.dtype for value in (light.radiance, light.scale, light.rotation)} == {
        torch.float64
    }


@pytest.mark.parametrize(("intensity", "colors"), [(5, [5]), ([1, 2, 3], [1, 2, 3])])
def test_a_point_light(intensity: Any, colors: list[float], write: Write):
    (light,) = load_scene(
        write(lit_by({"type": "point", "position": [0, 2, -1], "intensity": intensity}))
    ).lights
    assert (
        isinstance(light, PointLight)
        and light.position.tolist() == [0, 2, -1]
        and light.intensity.tolist() == colors
    )


def test_lights_are_written_back(write: Write, tmp_path: Path):
    text = lit_by(
        {"type": "environment", "file": "sky.npy", "rotation": 30},
        {"type": "point", "position": [0, 2, 0], "intensity": 5},
    )
    scene_file = read_scene(write(text))
    assert scene_file.tree.lights == (
        EnvironmentSection(tmp_path / "sky.npy", rotation=30.0),
        PointSection((0, 2, 0), 5.0),
    )
    dump_scene(scene_file, tmp_path / "again.yaml")
    assert read_scene(tmp_path / "again.yaml").tree.lights == scene_file.tree.lights


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (
            {"type": "environment", "file": "sky.npy", "scale": -1},
            "lights.0.scale: must be at least 0",
        ),
        (
            {"type": "environment", "file": "sky.npy", "directions": 0},
            "lights.0.directions: must be at least 1",
        ),
        ({"type": "environment"}, "lights.0: missing key 'file'"),
        ({"type": "environment", "file": "none.exr"}, "lights.0.file: none.exr does not exist"),
        (
            {"type": "point", "position": [0, 1], "intensity": 1},
            "lights.0.position: expected a list of 3 numbers",
        ),
        (
            {"type": "point", "position": [0, 1, 2], "intensity": -1},
            "lights.0.intensity: must be at least 0",
        ),
    ],
)
def test_what_a_scene_may_not_say(
    entry: dict[str, Any], expected: str, write: Write, tmp_path: Path
):
    path = write(lit_by(entry))
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    (line,) = caught.value.problems
    assert expected in line.replace(f"{tmp_path}/", "")


def test_problems_of_all_lights_are_told_together(write: Write):
    path = write(lit_by(*({"type": "environment", "file": name} for name in ("a.exr", "b.exr"))))
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert len(caught.value.problems) == 2


def test_negative_radiance_is_taken_as_none_with_a_warning(write: Write, tmp_path: Path):
    pixels = save_map(tmp_path, 4, 6, 3)
    pixels[1, 2, 0] = pixels[2, 5, 2] = -1e-3
    np.save(tmp_path / "sky.npy", pixels)
    with pytest.warns(
        DataWarning,
        match="2 pixels with negative radiance are taken as 0, the first at row 1, column 2",
    ):
        (light,) = load_scene(write(lit_by({"type": "environment", "file": "sky.npy"}))).lights
    assert torch.equal(
        light.radiance, torch.from_numpy(pixels.clip(min=0)).permute(2, 0, 1).float()
    )


@pytest.mark.parametrize("shape", [(1, 6, 3), (4, 2, 3)], ids=str)
def test_a_map_must_go_around(shape: tuple[int, ...], write: Write, tmp_path: Path):
    save_map(tmp_path, *shape)
    with pytest.raises(FormatError, match="at least 3 x 2 pixels"):
        load_scene(write(lit_by({"type": "environment", "file": "sky.npy"})))
