"""A lock keeps others out of a folder while its process lives, and no longer; files are written
where nothing is, unless it may be replaced, and only into existing folders.
"""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ddrecon.errors import UsageError
from ddrecon.io.files.folders import LOCK, hold_lock, require_free_files

SCRIPT = """
import os, sys
from pathlib import Path
from ddrecon.io.files.folders import hold_lock
with hold_lock(Path(sys.argv[1])):
    exec(sys.argv[2])
"""
HOLD = sys.executable, "-c", SCRIPT


def holder(folder: Path) -> dict[str, object]:
    content: dict[str, object] = json.loads((folder / LOCK).read_text())
    return content


def test_a_second_holder_is_refused_and_told_which_process_is_the_first(tmp_path: Path) -> None:
    command = [*HOLD, tmp_path, "print('held', flush=True); input()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout is not None and first.stdout.readline() == b"held\n"
        for _ in range(2):
            with pytest.raises(UsageError) as refused, hold_lock(tmp_path):
                pass
            assert str(refused.value) == (
                f"{tmp_path}: process {first.pid} is writing there; "
                "wait for it, or choose another folder"
            )
        first.communicate(b"\n")
    assert list(tmp_path.iterdir()) == []


def test_a_killed_process_blocks_nobody(tmp_path: Path) -> None:
    assert subprocess.run([*HOLD, tmp_path, "os.kill(os.getpid(), 9)"]).returncode == -9
    assert holder(tmp_path)["pid"] != os.getpid()
    with hold_lock(tmp_path):
        assert holder(tmp_path)["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", ["", "{}", "[1]", "hello"])
def test_a_file_that_nobody_holds_blocks_nobody(tmp_path: Path, content: str) -> None:
    (tmp_path / LOCK).write_text(content)
    with hold_lock(tmp_path):
        assert holder(tmp_path)["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


def test_of_several_processes_that_ask_at_once_one_goes_in(tmp_path: Path) -> None:
    """Each counts those inside, over and over; never is there another."""
    script = """
import os, sys
from pathlib import Path
from ddrecon.errors import UsageError
from ddrecon.io.files.folders import hold_lock
folder, inside = Path(sys.argv[1]), Path(sys.argv[2])
entered = 0
while entered < 100:
    try:
        with hold_lock(folder):
            os.close(os.open(inside, os.O_CREAT | os.O_EXCL))
            inside.unlink()
            entered += 1
    except UsageError as error:
        assert "is writing there" in str(error), error
"""
    (tmp_path / "shared").mkdir()
    command = [sys.executable, "-c", script, tmp_path / "shared", tmp_path / "inside"]
    processes = [subprocess.Popen(command) for _ in range(3)]
    assert [process.wait() for process in processes] == [0, 0, 0]
    assert list((tmp_path / "shared").iterdir()) == []


def test_the_lock_of_another_host_is_kept(tmp_path: Path) -> None:
    content = '{"pid": 1, "host": "elsewhere"}'
    (tmp_path / LOCK).write_text(content)
    line = f"{tmp_path}: process 1 on 'elsewhere' is writing there; if it is not, remove "
    with pytest.raises(UsageError) as refused, hold_lock(tmp_path):
        pass
    assert str(refused.value) == f"{line}{tmp_path / LOCK}"
    assert (tmp_path / LOCK).read_text() == content


def test_what_cannot_be_locked_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / LOCK).mkdir()
    with pytest.raises(UsageError, match=f"{LOCK}: cannot be locked: Is a directory"):
        hold_lock(tmp_path).__enter__()
    (tmp_path / LOCK).rmdir()

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.raises(UsageError, match="cannot be locked: Function not implemented"):
        hold_lock(tmp_path).__enter__()


def test_every_file_that_is_there_is_named_unless_it_may_be(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("one", "two", "three")]
    for path in paths[1:]:
        path.touch()
    with pytest.raises(UsageError, match=r"/two, .*/three: already there; .* say --overwrite"):
        require_free_files(paths, may_exist=False)
    require_free_files(paths, may_exist=True)


@pytest.mark.parametrize("may_exist", [False, True])
def test_a_folder_that_is_missing_or_a_file_is_refused(tmp_path: Path, may_exist: bool) -> None:
    (tmp_path / "file").touch()
    for folder in ("gone", "file"):
        with pytest.raises(UsageError, match=f"there is no folder .*{folder}"):
            require_free_files([tmp_path / folder / "one"], may_exist=may_exist)
