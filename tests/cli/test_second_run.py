"""Of two commands that write to the same folder, the second is refused while the first is at it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from ddrecon.io.files.folders import LOCK, claim_folder

COMMANDS = {
    "optimize": ["optimize", "scene.yaml", "-q", "-o", "out", "--iterations", "1"],
    "render": ["render", "scene.yaml", "-q", "-o", "out"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_second_run_is_refused(run: Callable[..., Result], command: str) -> None:
    line = f"out: process {os.getpid()} is writing there; wait for it, or choose another folder\n"
    with claim_folder(Path("out"), may_exist=False):
        for more in ([], ["--overwrite"]):
            result = run(*COMMANDS[command], *more)
            assert (result.exit_code, result.stderr, result.stdout) == (2, line, "")
    assert run(*COMMANDS[command]).exit_code == 0
    assert not Path("out", LOCK).exists()
