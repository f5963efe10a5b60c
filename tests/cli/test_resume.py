"""Runs that stop and go on: an interrupt loses nothing, and resuming changes no bit."""

import csv
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

from ddrecon.reconstruct import loop
from ddrecon.reconstruct.parameters import Parameter

Run = Callable[..., Result]
DensityOf = Callable[[str], np.ndarray]
FINER = ["-D", "volume.resolution=[16, 8, 8]", "-D", "optimize.refine_at=[0.5]"]
OPTIMIZE = ["optimize", "scene.yaml", "-q", "--iterations", "4", *FINER, "-o"]


def iterations(folder: str) -> list[int]:
    return [
        int(line.split(",")[0]) for line in Path(folder, "loss.csv").read_text().splitlines()[1:]
    ]


def cells(folder: str) -> list[int]:
    with Path(folder, "loss.csv").open(newline="") as stream:
        return [int(row["cells"]) for row in csv.DictReader(stream)]


def press_ctrl_c_in(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, call: int) -> None:
    """Ctrl-C arrives once, at the end of call number `call` of `owner.name`."""
    original, calls = getattr(owner, name), []

    def pressed(*arguments: Any, **options: Any) -> Any:
        result = original(*arguments, **options)
        calls.append(name)
        if len(calls) == call:
            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(owner, name, pressed)


@pytest.mark.parametrize(
    ("owner", "name", "call"),
    [
        pytest.param(loop, "differentiate", 3, id="after a render at a new resolution"),
        pytest.param(Parameter, "step", 1, id="after the first step"),
        pytest.param(Parameter, "step", 3, id="after a later step"),
    ],
)
def test_an_interrupted_run_goes_on_to_the_same_bits(
    run: Run,
    succeed: Run,
    density_of: DensityOf,
    monkeypatch: pytest.MonkeyPatch,
    owner: Any,
    name: str,
    call: int,
) -> None:
    succeed(*OPTIMIZE, "whole")
    with monkeypatch.context() as patch:
        press_ctrl_c_in(patch, owner, name, call)
        result = run(*OPTIMIZE, "parts")
    assert (result.exit_code, result.stdout) == (130, "")
    assert len(result.stderr.splitlines()) == 1 and "interrupted" in result.stderr
    assert len(iterations("parts")) in (call - 1, call)
    assert Path("parts/checkpoints/last.pt").is_file()
    succeed(*OPTIMIZE, "parts", "--resume")
    assert iterations("parts") == [1, 2, 3, 4]
    assert np.array_equal(density_of("parts"), density_of("whole"))


def test_more_iterations_go_on_from_the_end(succeed: Run) -> None:
    """At the resolution that was reached, and by the folder's own scene as well."""
    command = ["optimize", "scene.yaml", "-q", *FINER, "-o", "out", "--iterations"]
    succeed(*command, "2")
    first, reached = Path("out/loss.csv").read_text(), cells("out")[-1]
    assert reached == 16 * 8 * 8
    succeed(*command, "4", "--resume")
    succeed("optimize", "out/scene.yaml", "-q", "--iterations", "5", "-o", "out", "--resume")
    assert iterations("out") == [1, 2, 3, 4, 5] and set(cells("out")[2:]) == {reached}
    assert Path("out/loss.csv").read_text().startswith(first)


def wait_for_rows(process: subprocess.Popen[str], log: Path, count: int) -> None:
    end = time.monotonic() + 60
    while not log.exists() or log.read_text().count("\n") <= count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.slow
def test_ctrl_c_in_a_terminal(folder: Path, succeed: Run) -> None:
    command = [sys.executable, "-m", "ddrecon", "optimize", "scene.yaml", "-o", "out"]
    command += ["--iterations", "100000"]
    process = subprocess.Popen(
        command,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        wait_for_rows(process, Path("out/loss.csv"), 3)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=30)
    finally:
        process.kill()
    assert (process.returncode, stdout) == (130, "") and "Traceback" not in stderr
    done = len(iterations("out"))
    succeed("optimize", "scene.yaml", "-q", "-o", "out", "--resume", "--iterations", str(done + 2))
    assert iterations("out") == list(range(1, done + 3))
