"""A run shared by several processes is the run of one, and loses nothing where one is killed."""

from __future__ import annotations

import numpy as np
import pytest
from shared_runs import RENDER, TESTS, VIEWS, Runs, job, run_jobs

from ddrecon.run.checkpoint import load_checkpoint

pytestmark = pytest.mark.slow
JOBS = {
    "one": job(1, "one"),
    "four": job(4, "four", seeds=True),
    "killed": job(2, "broken", failing=[1, 3, "killed"]),
    "resumed": job(3, "broken", "--resume"),
    "first killed": job(2, "headless", failing=[0, 2, "killed"]),
    "failed": job(2, "failed", failing=[1, 1, "is odd"]),
    "refused": job(2, "one"),
    "rendered": {"ranks": 3, "arguments": [*RENDER, "views"]},
    "alone": {"ranks": 1, "arguments": [*RENDER, "alone"]},
    "checked": {"ranks": 2, "arguments": ["check", "scene.yaml"]},
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    return run_jobs(tmp_path_factory.mktemp("ranks"), JOBS)


@pytest.mark.parametrize("output", ["four", "broken"])
def test_ranks_find_what_one_finds(runs: Runs, output: str) -> None:
    runs.compare(output, "one")


def test_the_first_rank_alone_prints(runs: Runs) -> None:
    for name in ("four", "rendered", "checked"):
        assert set(runs.codes[name]) == {0}
        assert runs.text(name, 0, "out")
        assert (runs.text(name, 1, "out"), runs.text(name, 1, "err")) == ("", "")


def test_a_killed_rank_loses_nothing(runs: Runs) -> None:
    assert runs.codes["killed"] == [5, -9]
    line = runs.text("killed", 0, "err").splitlines()[-1]
    assert line.startswith("another rank has ended (")
    assert "the state after 2 iterations is kept in broken/checkpoints/last.pt" in line
    assert runs.codes["resumed"] == [0, 0, 0]


def test_a_checkpoint_stands_where_the_first_rank_is_killed(runs: Runs) -> None:
    assert runs.codes["first killed"] == [-9, 5]
    state = load_checkpoint(runs.folder / "headless" / "checkpoints")[0]
    assert state["total"]["iteration"] == 0


def test_a_rank_that_fails_says_why(runs: Runs) -> None:
    assert runs.codes["failed"] == [5, 3]
    assert runs.text("failed", 1, "err").splitlines() == ["rank 1: some.file: is odd"]
    assert "another rank has ended (" in runs.text("failed", 0, "err")
    assert runs.codes["refused"] == [2, 5]
    assert runs.text("refused", 0, "err").startswith("one: the folder is not empty")
    assert runs.text("refused", 1, "err") == ""


def test_ranks_render_what_one_renders(runs: Runs) -> None:
    files = sorted(path.name for path in (runs.folder / "alone").iterdir())
    assert files == sorted(path.name for path in (runs.folder / "views").iterdir())
    arrays = [name for name in files if name.endswith(".npy")]
    assert len(arrays) == 2 * len(VIEWS | TESTS)
    for name in arrays:
        one, other = (np.load(runs.folder / output / name) for output in ("alone", "views"))
        np.testing.assert_array_equal(one, other)


def test_one_rank_imports_and_starts_nothing(runs: Runs) -> None:
    assert runs.text("one", 0, "out").splitlines()[-2:] == ["[]", "False"]
