"""Runs in slabs are those of one process; so are samples of a run that several share."""

from __future__ import annotations

import numpy as np
import pytest
from shared_runs import RENDER, TESTS, VIEWS, Job, Runs, job, run_jobs

pytestmark = pytest.mark.slow
WARM = "-D", "volume.resolution=[6, 25, 5]", "--engine", "torch"
TALL = *WARM, "-D", "diffusion.warm_start=false"
ROUNDS = "-D", "diffusion.transport_rounds=1", "-D", "diffusion.degree=1"
CELLS = "--share", "cells"


def sure(ranks: int, output: str, *options: str) -> Job:
    command = ["uncertainty", "one", "-o", output, "--engine", "torch"]
    roughly = ["--noise", "0.05", "--tolerance", "0.9", "--keep-samples"]
    return {"ranks": ranks, "arguments": [*command, *roughly, *options]}


JOBS = {
    "one": job(1, "one"),
    "sure": sure(1, "sure", "--samples", "3"),
    "sure begun": sure(1, "doubts", "--samples", "2"),
    "sure of three": sure(3, "doubts", "--samples", "3", "--resume"),
    "whole": job(1, "whole", *TALL, *ROUNDS),
    "warm": job(1, "warm", *WARM),
    "warm cells": job(2, "warm cells", *WARM, *CELLS),
    "cells killed": job(3, "torn", *TALL, *ROUNDS, *CELLS, failing=[2, 4, "killed"]),
    "cells resumed": job(2, "torn", *TALL, *ROUNDS, *CELLS, "--resume", "--preview-every", "4"),
    "cells refused": job(2, "none", *TALL, *CELLS, "-D", "diffusion.model=flux_limited"),
    "tall": {"ranks": 1, "arguments": [*RENDER, "tall", *TALL]},
    "tall cells": {"ranks": 2, "arguments": [*RENDER, "tall cells", *TALL, *CELLS]},
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    return run_jobs(tmp_path_factory.mktemp("ranks"), JOBS)


@pytest.mark.parametrize(("output", "alone"), [("torn", "whole"), ("warm cells", "warm")])
def test_slabs_find_what_one_finds(runs: Runs, output: str, alone: str) -> None:
    """Also where solves begin at the last solutions, carried from resolution to resolution."""
    runs.compare(output, alone)


def test_ranks_render_in_slabs_what_one_renders(runs: Runs) -> None:
    assert runs.codes["tall"] == [0] and runs.codes["tall cells"] == [0, 0]
    arrays = sorted(path.name for path in (runs.folder / "tall").glob("*.npy"))
    assert len(arrays) == 2 * len(VIEWS | TESTS)
    for name in arrays:
        one, other = (np.load(runs.folder / output / name) for output in ("tall", "tall cells"))
        np.testing.assert_allclose(other, one, rtol=1e-3, atol=1e-5 * abs(one).max())


def test_what_slabs_cannot_do_is_refused(runs: Runs) -> None:
    assert runs.codes["cells refused"][0] == 2
    lines = runs.text("cells refused", 0, "err").splitlines()
    assert len(lines) == 1 and lines[0].startswith("--share cells: diffusion.model: flux_limited")
    assert not (runs.folder / "none").exists()


def test_previews_and_pictures_are_of_all_slabs(runs: Runs) -> None:
    names = sorted(path.name for path in (runs.folder / "torn" / "previews").iterdir())
    assert "c.png" in names and "c.000004.png" in names
    assert (runs.folder / "torn" / "report.html").is_file()


def test_ranks_draw_the_samples_of_one(runs: Runs) -> None:
    """They go on where one has begun; the first of them alone writes."""
    assert runs.codes["sure begun"] == [0]
    assert runs.codes["sure of three"] == [0, 0, 0]
    assert runs.text("sure of three", 0, "out") and not runs.text("sure of three", 1, "out")
    one, other = (sorted((runs.folder / output).rglob("*.npz")) for output in ("sure", "doubts"))
    assert [path.name for path in one] == [path.name for path in other]
    assert "0002" in {path.parent.name for path in one}
    for known, found in zip(one, other, strict=True):
        for key, value in np.load(known).items():
            np.testing.assert_allclose(np.load(found)[key], value, rtol=1e-5, atol=1e-7)
