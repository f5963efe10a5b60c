"""Reading scene text, and the problems found in it."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from ddrecon.errors import DdreconError, SceneError
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.scene_file.load import SceneFile, read_scene


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Writes text to scene.yaml in the current folder and returns its path."""
    monkeypatch.chdir(tmp_path)

    def write_text(text: str) -> Path:
        path = tmp_path / "scene.yaml"
        path.write_text(text)
        return path

    return write_text


@pytest.fixture
def read(write: Callable[[str], Path]) -> Callable[..., SceneFile]:
    """Reads text as a scene, with overrides."""
    return lambda text, *overrides: read_scene(write(text), overrides)


@pytest.fixture
def load(write: Callable[[str], Path]) -> Callable[..., Scene]:
    """Text as a scene of tensors, by default in double precision."""
    return lambda text, dtype=torch.float64: load_scene(write(text), dtype=dtype)


@pytest.fixture
def refusal(write: Callable[[str], Path], tmp_path: Path) -> Callable[..., list[str]]:
    """The problem lines of text refused as a scene, without the folder, by `kind` of fault."""

    def problems(text: str, *overrides: str, kind: type[DdreconError] = SceneError) -> list[str]:
        with pytest.raises(kind) as caught:
            read_scene(write(text), overrides)
        return [line.replace(f"{tmp_path}/", "") for line in str(caught.value).splitlines()]

    return problems
