"""Cells in slabs: what ranks find together is what one finds alone, to rounding."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from media import box_grid
from slab_cases import CASES, FUSED

from ddrecon.slabs.slab import HALO, THINNEST, Slab, cut_evenly

Errors = dict[str, dict[str, float]]


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> Errors:
    return find_errors(tmp_path_factory.mktemp("slabs") / "errors.json", "torch")


@pytest.fixture(scope="module")
def fused_errors(tmp_path_factory: pytest.TempPathFactory) -> Errors:
    return find_errors(tmp_path_factory.mktemp("slabs") / "fused.json", "warp")


def find_errors(file: Path, engine: str) -> Errors:
    script = Path(__file__).with_name("slab_cases.py")
    paths = [str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(paths)}
    subprocess.run([sys.executable, str(script), str(file), engine], env=environment, check=True)
    found: Errors = json.loads(file.read_text())
    return found


@pytest.mark.parametrize("case", CASES)
def test_slabs_find_what_one_process_finds(errors: Errors, case: str) -> None:
    assert errors[case]
    assert {what: error for what, error in errors[case].items() if not error < 1e-12} == {}


@pytest.mark.slow
@pytest.mark.parametrize("case", FUSED)
def test_fused_slabs_find_what_operations_of_one_process_find(
    fused_errors: Errors, case: str
) -> None:
    assert fused_errors[case]
    assert {what: e for what, e in fused_errors[case].items() if not e < 1e-11} == {}


@given(st.integers(1, 9), st.integers(0, 400))
def test_slabs_are_even_and_whole_pairs(ranks: int, more: int) -> None:
    cells = ranks * THINNEST + more
    cuts = cut_evenly(cells, ranks)
    sizes = [after - before for before, after in pairwise(cuts)]
    assert cuts[0] == 0 and cuts[-1] == cells and len(sizes) == ranks
    assert all(cut % 2 == 0 for cut in cuts[:-1])
    assert max(sizes) - min(sizes) <= 4


@given(st.integers(2, 5), st.integers(0, 20), st.integers(0, 2))
def test_a_slab_lies_where_its_cells_do(ranks: int, more: int, axis: int) -> None:
    shape = [3, 4, 5]
    shape[axis] = ranks * THINNEST + more + 2
    whole = box_grid((shape[0], shape[1], shape[2]))
    cuts = cut_evenly(shape[axis], ranks)
    slabs = [Slab.of(whole, axis, cuts, rank) for rank in range(ranks)]
    for slab in slabs:
        assert slab.spacing == pytest.approx(whole.spacing)
        assert slab.lower[axis] == pytest.approx(
            whole.lower[axis] + slab.first * whole.spacing[axis]
        )
        assert all(halo in (0, HALO) for halo in slab.halo)
    for below, above in pairwise(slabs):
        assert below.ends[1] == above.ends[0]
    assert (slabs[0].ends[0], slabs[-1].ends[1]) == (None, None)
