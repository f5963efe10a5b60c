"""The section volume.media: what it becomes, what is written back, and what is refused."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from example_scene import changed

from ddrecon.medium.coefficients import mix_media
from ddrecon.medium.phase import Blend, Rayleigh
from ddrecon.run.result import describe_result, result_names
from ddrecon.scene_file.build import build_scene, load_scene
from ddrecon.scene_file.load import describe, dump_scene, read_scene
from ddrecon.variables.values import value_of

CLOUD = {"density": {"file": "cloud.npz"}, "sigma_t": 20, "albedo": 0.9, "g": 0.8}
AIR = {"density": 0.5, "sigma_a": 0, "sigma_s": [0.1, 0.2, 0.4], "phase": {"type": "rayleigh"}}


@pytest.fixture(autouse=True)
def cloud(tmp_path: Path) -> None:
    density = np.linspace(0, 1, 24, dtype=np.float32).reshape(4, 3, 2)
    np.savez(tmp_path / "cloud.npz", density=density, bounds=np.array([[0, 0, 0], [2, 3, 4]]))


def text_of(**media: Any) -> str:
    return changed(volume={"media": media}, optimize=None)


def test_two_media_are_their_mixture_and_are_written_back(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    scene_file = read_scene(write(text_of(cloud=CLOUD, air=AIR)))
    volume = build_scene(scene_file).volume
    assert volume.grid.shape == (4, 3, 2) and isinstance(volume.phase, Blend)
    assert isinstance(volume.phase.second, Rayleigh) and volume.media is not None
    assert volume.media["cloud"].g == torch.tensor(0.8)
    expected = mix_media(volume.media)
    dump_scene(describe(scene_file), tmp_path / "again.yaml")
    for found in (volume, load_scene(tmp_path / "again.yaml").volume):
        assert torch.equal(found.sigma_a, expected.sigma_a)
        assert torch.equal(found.sigma_s, expected.sigma_s)
        assert torch.equal(found.phase.numbers[-1], expected.phase.numbers[-1])


def test_what_is_found_of_a_medium_is_put_into_it(
    write: Callable[[str], Path], tmp_path: Path
) -> None:
    optimize = {"parameters": {"media.cloud.albedo": {"init": 0.5}, "media.air.sigma_s": {}}}
    path = write(changed(volume={"media": {"cloud": CLOUD, "air": AIR}}, optimize=optimize))
    scene_file = read_scene(path, ["optimize.parameters.media.cloud.g.init=0.3"])
    scene = build_scene(scene_file)
    assert scene.starts["media.cloud.g"] == torch.tensor(0.3)
    assert float(scene.starts["media.cloud.albedo"]) == 0.5
    names = result_names(list(scene.starts))
    values = {name: value_of(scene, name).squeeze().tolist() for name in names}
    values |= {"media.cloud.g": 0.4, "media.air.sigma_s": [0.3, 0.2, 0.1]}
    described = describe_result(scene_file, scene, values)
    dump_scene(described, tmp_path / "result.yaml")
    media = load_scene(tmp_path / "result.yaml").volume.media
    assert media is not None and media["cloud"].g == torch.tensor(0.4)
    assert media["air"].sigma_s.tolist() == pytest.approx([0.3, 0.2, 0.1])
    assert float(media["cloud"].sigma_s) == pytest.approx(18)
