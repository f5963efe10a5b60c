"""Loops that are to be vector code are, and compute the same: other tests do not optimize."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("warp", reason="Warp is not installed (extra `fast`)")

TESTS = Path(__file__).parents[1]
OF_EACH_HEADER = (
    "light/test_fused_light.py::test_single_precision",
    "light/test_fused_light.py::test_light_of_any_degree[3-True]",
    "diffusion/test_fused_diffusion.py::test_around_a_period_they_agree[shape0-periodic0]",
    "diffusion/test_fused_diffusion.py::test_a_million_to_one[1-torch.float32]",
    "transport/test_fused_sweep.py::test_single_precision[(1.0, 1.0, 1.0)]",
)


@pytest.mark.slow
def test_loops_become_vector_code(tmp_path):
    """Kernels are compiled anew as users have them, in a cache of their own."""
    found = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "0", "-s", *(TESTS / one for one in OF_EACH_HEADER)],
        cwd=TESTS.parent,
        env=os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache"), "OPTIMIZE_KERNELS": "yes"},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stdout
    assert len(list((tmp_path / "cache").rglob("*.cpp"))) > 10
    assert "loop not vectorized" not in found.stderr
