"""What an iteration asks of a graphics card: launches, and reads for which a processor waits."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("warp", reason="Warp is not installed (extra `fast`)")
from as_on_a_gpu import as_on_a_gpu
from tape import record

from ddrecon.engine import use_engine
from ddrecon.reconstruct.gradients import Replays

MOST_READS, MOST_WRITES = 20, 4
MOST_LAUNCHES = {"a round": 950, "plume.yaml": 1_260}
"""Of 16 x 24 x 16 cells; where they are four times as many along each axis, at most 1,700 and
2,100, as `benchmarks/launches.py` counts: for more slices and more grids.
"""


@pytest.fixture(scope="module")
def launches():
    path = Path(__file__).parents[2] / "benchmarks" / "launches.py"
    sys.path.append(str(path.parent))  # of its neighbors
    spec = importlib.util.spec_from_file_location("launches", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its records look themselves up there
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("case", MOST_LAUNCHES)
def test_an_iteration_launches_and_waits_seldom(launches, case):
    """The paper's plume in one view, with a round; and three views in color."""
    use_engine("warp")
    with as_on_a_gpu():
        if case == "plume.yaml":
            run = launches.start_plume(factor=4)
        else:
            run = launches.start_paper_case(16, 128, 1)
        counts = launches.count(run)
    assert counts["call"] + counts["launch"] <= MOST_LAUNCHES[case], counts
    assert counts["read"] <= MOST_READS, counts
    assert counts["write"] <= MOST_WRITES, counts


@pytest.mark.slow
def test_a_recorded_iteration_reads_twice(launches):
    """Losses with residuals, and the slope with what else the search decides by."""
    use_engine("warp")
    run = launches.start_paper_case(12, 48, 1)
    (frame,) = run.frames
    # A GPU takes all pixels' rays.
    scene = frame.replays.scene
    replays = Replays(replace(scene, render=replace(scene.render, tolerance=0)), lambda: record)
    frame.replays = replays
    counts = launches.count(run)
    assert replays.recording is not None
    assert counts["read"] == 2 and counts["write"] <= 2, counts
