"""Reading scene text, and the problems found in it."""

import pytest
import torch

from ddrecon.errors import SceneError
from ddrecon.scene_file.build import load_scene
from ddrecon.scene_file.load import read_scene


@pytest.fixture
def write(tmp_path, monkeypatch):
    """Writes text to scene.yaml in the current folder and returns its path."""
    monkeypatch.chdir(tmp_path)

    def write_text(text):
        path = tmp_path / "scene.yaml"
        path.write_text(text)
        return path

    return write_text


@pytest.fixture
def read(write):
    """Reads text as a scene, with overrides."""
    return lambda text, *overrides: read_scene(write(text), overrides)


@pytest.fixture
def load(write):
    """Text as a scene of tensors, by default in double precision."""
    return lambda text, dtype=torch.float64: load_scene(write(text), dtype=dtype)


@pytest.fixture
def refusal(write, tmp_path):
    """The problem lines of text refused as a scene, without the folder, by `kind` of fault."""

    def problems(text, *overrides, kind=SceneError):
        with pytest.raises(kind) as caught:
            read_scene(write(text), overrides)
        return [line.replace(f"{tmp_path}/", "") for line in str(caught.value).splitlines()]

    return problems
