"""Cells in slabs: what ranks find together is what one finds alone, to rounding."""

import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from slab_cases import CASES_OF

from ddrecon.slabs.slab import THINNEST, cut_evenly

Errors = dict[str, dict[str, dict[str, float]]]
LIMITS = {"torch": 1e-12, "warp": 1e-11}


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> Errors:
    """Those of all cases, by engine; one process forks all ranks."""
    file = tmp_path_factory.mktemp("slabs") / "errors.json"
    script = Path(__file__).with_name("slab_cases.py")
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, str(script), str(file)], env=environment, check=True)
    found: Errors = json.loads(file.read_text())
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("engine", "case"), [(engine, case) for engine in LIMITS for case in CASES_OF[engine]]
)
def test_slabs_find_what_one_process_finds(errors: Errors, engine: str, case: str) -> None:
    """Fused slabs find what operations of one process find."""
    found = errors[engine][case]
    assert found and {what: e for what, e in found.items() if not e < LIMITS[engine]} == {}


@given(st.integers(1, 9), st.integers(0, 400))
def test_slabs_are_even_and_whole_pairs(ranks: int, more: int) -> None:
    cells = ranks * THINNEST + more
    cuts = cut_evenly(cells, ranks)
    sizes = [after - before for before, after in pairwise(cuts)]
    assert cuts[0] == 0 and cuts[-1] == cells and len(sizes) == ranks
    assert all(cut % 2 == 0 for cut in cuts[:-1])
    assert max(sizes) - min(sizes) <= 4
