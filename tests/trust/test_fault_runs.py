"""A run killed, interrupted or out of space ends with the bits of one left alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).parent / "fault_runs.py"


def test_no_fault_loses_anything(tmp_path):
    """Of 4 signals two are SIGKILL, one SIGTERM and one Ctrl-C; twice there is no space."""
    found = subprocess.run(
        [sys.executable, SCRIPT, tmp_path, "4", "2"],
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
    )
    assert found.returncode == 0, found.stderr
    killed, full = json.loads(found.stdout)
    assert killed["wrong"] == [] == full["wrong"]
    assert killed["faults"] == 4 and killed["finished"] >= 1 and full["faults"] >= 1
