"""A small legal scene in a folder of its own, and commands run on it in this process."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import Result
from small_scene import SCENE, contents

from ddrecon.io.volumes.table import write_field

Run = Callable[..., Result]


@pytest.fixture(autouse=True)
def surroundings(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What commands change in their process is put back; Ctrl-C works in the background too."""
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")
    yield
    signal.signal(signal.SIGINT, handler)
    torch.set_num_threads(threads)
    torch.set_rng_state(state)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with scene.yaml, its images front.npy and side.npy, and density.npz."""
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(SCENE)
    y, x = np.mgrid[-1:1:6j, -1:1:8j]
    picture = np.maximum(0.5 - x**2 - y**2, 0.1)[..., None] * [1.0, 0.8, 0.6]
    for name in ("front", "side"):
        np.save(f"{name}.npy", picture.astype(np.float32))
    values = np.random.default_rng(0).random((4, 5, 6))
    write_field(Path("density.npz"), "density", values, np.array([[-0.5] * 3, [0.5] * 3]))
    return tmp_path


@pytest.fixture
def succeed(run: Run) -> Run:
    """Runs a command that must exit with 0."""

    def run_well(*arguments: str) -> Result:
        result = run(*arguments)
        assert result.exit_code == 0, result.stderr
        return result

    return run_well


@pytest.fixture
def refuse(run: Run, folder: Path) -> Callable[..., list[str]]:
    """The lines on stderr of a command that must exit with `code`, and print and write nothing."""

    def run_badly(code: int, *arguments: str) -> list[str]:
        before = contents(folder)
        result = run(*arguments)
        assert (result.exit_code, result.stdout) == (code, ""), result.output
        assert contents(folder) == before
        return [line.replace(f"{folder}/", "") for line in result.stderr.splitlines()]

    return run_badly


@pytest.fixture
def density_of() -> Callable[[str], np.ndarray]:
    """The density in the folder of a run."""

    def read(run_folder: str) -> np.ndarray:
        with np.load(Path(run_folder) / "volumes" / "density.npz", allow_pickle=False) as archive:
            return archive["density"]

    return read
