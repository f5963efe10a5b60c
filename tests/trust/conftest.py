"""A tiny scene in a folder of its own, and commands run on it in this process."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from tiny_scene import write_scene


@pytest.fixture(autouse=True)
def surroundings(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What commands change in their process is put back."""
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    yield
    torch.set_num_threads(threads)
    torch.set_rng_state(state)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with scene.yaml and its images."""
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path)
    return tmp_path
