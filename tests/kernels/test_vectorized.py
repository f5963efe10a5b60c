"""Loops that are written to be vector code are: clang says of others that it could not."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("warp", reason="Warp is not installed (extra `fast`)")

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_loops_become_vector_code(tmp_path: Path) -> None:
    """Of all kernels of an iteration, which are compiled anew in a cache of their own."""
    words = "optimize", ROOT / "configs" / "ball.yaml", "--iterations", "1", "-o", tmp_path / "run"
    words += ("--engine", "warp")
    found = subprocess.run(
        [sys.executable, "-m", "ddrecon", *words],
        env=os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stderr
    assert len(list((tmp_path / "cache").rglob("*.cpp"))) > 10
    assert "loop not vectorized" not in found.stderr
