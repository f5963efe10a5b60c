"""What an iteration asks of a graphics card: launches, and reads for which a processor waits."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("warp", reason="Warp is not installed (extra `fast`)")
from as_on_a_gpu import as_on_a_gpu

from ddrecon.engine import use_engine
from ddrecon.reconstruct.levels import scene_at_level

MOST_LAUNCHES, MOST_READS, MOST_WRITES = 2_700, 20, 10


@pytest.fixture(scope="module")
def launches() -> ModuleType:
    path = Path(__file__).parents[2] / "benchmarks" / "launches.py"
    spec = importlib.util.spec_from_file_location("launches", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its records look themselves up there
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_an_iteration_of_the_plume_launches_and_waits_seldom(launches: ModuleType) -> None:
    """A quarter as wide; of three views, with a round."""
    use_engine("warp")
    scene = scene_at_level(launches.load(3, 1, "cpu"), 4)
    with as_on_a_gpu():
        counts = launches.count(scene)
    assert counts.total("call", "launch") <= MOST_LAUNCHES, counts.of
    assert counts.total("read") <= MOST_READS, counts.of
    assert counts.total("write") <= MOST_WRITES, counts.of
