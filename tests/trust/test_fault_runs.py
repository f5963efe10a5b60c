"""Faults at random moments lose nothing: a run killed, interrupted or out of space ends with the
bits of one left alone.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).parent / "fault_runs.py"


@pytest.mark.parametrize(("kind", "count"), [("kill", 12), ("full", 3)])
def test_no_fault_loses_anything(tmp_path: Path, kind: str, count: int) -> None:
    """Of 12 signals 10 are SIGKILL, one SIGTERM and one Ctrl-C."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    found = subprocess.run(
        [sys.executable, SCRIPT, kind, tmp_path, str(count)],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stderr
    report = json.loads(found.stdout)
    assert report["wrong"] == []
    assert report["finished"] >= 1 and (
        report["faults"] == count or (kind == "full" and report["faults"] >= count // 2)
    )
