"""A Python that has the module `openvdb`: this one, or the system's, of Debian's package."""

import functools
import json
import subprocess
import sys
from pathlib import Path

import pytest

import ddrecon

CANDIDATES = (sys.executable, "/usr/bin/python3")
IMPORT = """
import importlib.util as u, numpy
exit(not (u.find_spec('openvdb') or u.find_spec('pyopenvdb')))
"""
NAMES = """
import json, sys
try: import openvdb as vdb
except ImportError: import pyopenvdb as vdb
grids = {g.name: g for g in vdb.readAll(sys.argv[1])[0]}
"""


@functools.cache
def require() -> str:
    """The path of that Python; the test is skipped where there is none."""
    for python in CANDIDATES:
        if (
            Path(python).exists()
            and subprocess.run([python, "-c", IMPORT], capture_output=True).returncode == 0
        ):
            return python
    pytest.skip("no Python here has the module openvdb: apt-get install python3-openvdb")


def run(code: str, *arguments: object) -> str:
    """What `code` prints there; raises AssertionError with its stderr where it fails."""
    environment = {"PYTHONPATH": str(Path(ddrecon.__file__).parents[1])}
    done = subprocess.run(
        [require(), "-c", code, *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def described(code: str, path: Path) -> object:
    """The value, by JSON, of the expression `code` about `grids`: those in `path` by name."""
    return json.loads(run(f"{NAMES}print(json.dumps({code}))", path))
