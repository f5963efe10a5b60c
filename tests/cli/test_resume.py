"""Runs that stop and go on: an interrupt loses nothing, and resuming changes no bit."""

import csv
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

from ddrecon.errors import UsageError
from ddrecon.io.files.folders import LOCK, hold
from ddrecon.reconstruct import recording, tuning
from ddrecon.reconstruct.search import Search
from ddrecon.run import job, quality

Run = Callable[..., Result]
DensityOf = Callable[[str], np.ndarray]
FINER = ["-D", "volume.resolution=[16, 8, 8]"]
OPTIMIZE = ["optimize", "scene.yaml", "-q", "--iterations", "4", *FINER, "-o"]


def iterations(folder: str) -> list[int]:
    _, *rows = Path(folder, "loss.csv").read_text().splitlines()
    return [int(row.split(",")[0]) for row in rows]


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


@pytest.fixture(autouse=True)
def coarser(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has runs begin with cells twice as large."""
    monkeypatch.setattr(tuning, "FEWEST_CELLS", 4)


MOMENTS = {
    "after a render at a new resolution": (recording, "differentiate", 3),
    "after the first step": (Search, "judge", 1),
    "after a later step": (Search, "judge", 3),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_an_interrupted_run_goes_on_to_the_same_bits(
    run: Run, succeed: Run, density_of: DensityOf, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    call = MOMENTS[moment][-1]
    succeed(*OPTIMIZE, "whole")
    with monkeypatch.context() as patch:
        press_ctrl_c_in(patch, *MOMENTS[moment])
        result = run(*OPTIMIZE, "parts")
    assert (result.exit_code, result.stdout) == (130, "")
    assert len(result.stderr.splitlines()) == 1 and "interrupted" in result.stderr
    assert len(iterations("parts")) in (call - 1, call)
    assert Path("parts/checkpoints/last.pt").is_file()
    succeed(*OPTIMIZE, "parts", "--resume")
    assert iterations("parts") == [1, 2, 3, 4]
    assert np.array_equal(density_of("parts"), density_of("whole"))


def test_a_run_interrupted_after_its_end_is_told_how_to_finish(
    run: Run, succeed: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        press_ctrl_c_in(patch, quality, "register", 1)
        result = run(*OPTIMIZE, "out")
    told = "interrupted after 4 iterations; write its results with --resume\n"
    assert (result.exit_code, result.stderr) == (130, told)
    succeed(*OPTIMIZE, "out", "--resume")
    assert Path("out/report.html").is_file()


def test_the_report_is_there_while_a_run_goes_on(
    run: Run, succeed: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Browsers load it again and again until then."""
    monkeypatch.setattr("ddrecon.run.run_folder.PAGE_SECONDS", 0.0)
    succeed(*OPTIMIZE, "whole")
    with monkeypatch.context() as patch:
        press_ctrl_c_in(patch, Search, "judge", 3)
        assert run(*OPTIMIZE, "out").exit_code == 130
    begun = Path("out/report.html").read_text()
    assert "It goes on." in begun and 'http-equiv="refresh"' in begun
    assert all(f'<section id="{name}">' in begun for name in ("volume", "loss", "views"))
    succeed(*OPTIMIZE, "out", "--resume")
    done = Path("out/report.html").read_text()
    assert "It goes on." not in done and 'http-equiv="refresh"' not in done


def test_what_is_resumed_is_read_once_no_other_process_can_write(
    succeed: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    succeed(*OPTIMIZE, "out")
    load = job.load_checkpoint

    def load_locked(*arguments: Any) -> Any:
        with pytest.raises(UsageError, match="is writing there"), hold(Path("out", LOCK)):
            pass
        return load(*arguments)

    monkeypatch.setattr(job, "load_checkpoint", load_locked)
    succeed(*OPTIMIZE, "out", "--resume")


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
