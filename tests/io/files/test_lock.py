"""One process writes to a folder: a lock keeps others out while its process lives, and no longer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from ddrecon.errors import SceneError
from ddrecon.io.files.folders import claim_folder
from ddrecon.io.files.lock import LOCK, hold_lock

Run = Callable[..., Result]
COMMANDS = {
    "optimize": ["optimize", "scene.yaml", "-q", "-o", "out", "--iterations", "1"],
    "render": ["render", "scene.yaml", "-q", "-o", "out"],
}


def holder(folder: Path) -> dict[str, object]:
    content: dict[str, object] = json.loads((folder / LOCK).read_text())
    return content


@pytest.mark.parametrize("command", COMMANDS)
def test_a_second_run_is_refused(run: Run, command: str) -> None:
    with claim_folder(Path("out"), may_exist=False):
        for more in ([], ["--overwrite"]):
            result = run(*COMMANDS[command], *more)
            line = f"out: process {os.getpid()} is writing there; wait for it, or choose another folder\n"
            assert (result.exit_code, result.stderr, result.stdout) == (2, line, "")
    assert run(*COMMANDS[command]).exit_code == 0
    assert not Path("out", LOCK).exists()


def test_a_lock_goes_when_the_block_fails(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), hold_lock(tmp_path):
        assert holder(tmp_path)["pid"] == os.getpid()
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_the_lock_of_a_dead_process_is_stale(tmp_path: Path) -> None:
    script = "import os, sys; from pathlib import Path; from ddrecon.io.lock import locked\n"
    script += "with locked(Path(sys.argv[1])): os._exit(9)"
    assert subprocess.run([sys.executable, "-c", script, tmp_path]).returncode == 9
    assert (tmp_path / LOCK).exists()
    with hold_lock(tmp_path):
        assert holder(tmp_path)["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="this system does not tell when a process started"
)
@pytest.mark.parametrize("changed", [{"start": "1"}, {"boot": "another"}])
def test_the_lock_of_a_process_whose_number_was_used_again_is_stale(
    tmp_path: Path, changed: dict[str, str]
) -> None:
    with hold_lock(tmp_path):
        own = holder(tmp_path)
    (tmp_path / LOCK).write_text(json.dumps(own | changed))
    with hold_lock(tmp_path):
        assert holder(tmp_path) == own


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ('{"pid": 1, "host": "elsewhere"}', "'elsewhere' is writing"),
        ("", "does not say whose it is"),
    ],
)
def test_what_cannot_be_known_to_be_stale_is_kept(tmp_path: Path, content: str, what: str) -> None:
    (tmp_path / LOCK).write_text(content)
    with pytest.raises(SceneError, match=what), hold_lock(tmp_path):
        pass
    assert (tmp_path / LOCK).read_text() == content
