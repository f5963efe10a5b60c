"""Environment maps and point lights in scene files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from example_scene import changed

from ddrecon.errors import DataWarning
from ddrecon.light.lights import BeamLight, EnvironmentLight, PointLight
from ddrecon.scene_file.build import build_scene
from ddrecon.scene_file.load import describe, dump_scene, read_scene

TURNED = {"scale": 2.5, "rotation": -370.0, "directions": 12, "up": "z"}


@pytest.fixture
def pixels(tmp_path: Path) -> np.ndarray:
    """Those of sky.npy; two are negative."""
    pixels = np.random.default_rng(0).random((4, 6, 3)).astype(np.float32)
    pixels[1, 2, 0] = pixels[2, 5, 2] = -1e-3
    np.save(tmp_path / "sky.npy", pixels)
    return pixels


def test_lights_are_built_and_written_back(
    write: Callable[[str], Path], tmp_path: Path, pixels: np.ndarray
) -> None:
    sky = {"type": "environment", "file": "sky.npy"}
    point = {"type": "point", "position": [0, 2, -1]}
    lights = [sky, sky | TURNED, point | {"intensity": 5}, point | {"intensity": [1, 2, 3]}]
    lights.append(point | {"type": "beam", "direction": [0, -1, 0], "power": [1, 2, 3]})
    scene_file = read_scene(write(changed(lights=lights)))
    with pytest.warns(DataWarning, match="2 pixels with negative radiance are taken as 0"):
        plain, turned, gray, colored, pencil = build_scene(scene_file, dtype=torch.float64).lights
    assert isinstance(plain, EnvironmentLight) and isinstance(turned, EnvironmentLight)
    assert torch.equal(plain.radiance, torch.from_numpy(pixels.clip(0)).double().permute(2, 0, 1))
    numbers = turned.scale.item(), turned.rotation.item(), turned.directions, turned.up
    assert numbers == tuple(TURNED.values())
    assert (plain.scale, plain.rotation, plain.directions, plain.up) == (1, 0, 48, "y")
    assert isinstance(gray, PointLight) and isinstance(colored, PointLight)
    assert gray.position.tolist() == [0, 2, -1] and gray.intensity.tolist() == [5]
    assert colored.intensity.tolist() == [1, 2, 3]
    assert isinstance(pencil, BeamLight) and pencil.radius == 0
    assert pencil.power.tolist() == [1, 2, 3] and pencil.direction.tolist() == [0, -1, 0]
    dump_scene(describe(scene_file), tmp_path / "again.yaml")
    assert read_scene(tmp_path / "again.yaml").tree.lights == scene_file.tree.lights
