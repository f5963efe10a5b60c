"""A lock keeps others out of a folder while its process lives; files replace none unasked."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ddrecon.errors import UsageError
from ddrecon.io.files.folders import LOCK, claim_folder, require_free_files

SCRIPT = """
import os, sys
from pathlib import Path
from ddrecon.errors import UsageError
from ddrecon.io.files.folders import claim_folder
folder = Path(sys.argv[1])
"""
HOLD = SCRIPT + "with claim_folder(folder, 'run', overwrite=True): exec(sys.argv[2])"


def test_a_second_holder_is_refused_and_told_which_process_is_the_first(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, tmp_path, "print('in', flush=True); input()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout is not None and first.stdout.readline() == b"in\n"
        line = f"{tmp_path}: process {first.pid} is writing there; wait for it, or choose another"
        for _ in range(2):
            with (
                pytest.raises(UsageError, match=line),
                claim_folder(tmp_path, "run", overwrite=True),
            ):
                pass
        first.communicate(b"\n")
    assert list(tmp_path.iterdir()) == []


def test_what_nobody_holds_blocks_nobody(tmp_path: Path) -> None:
    """A killed process's lock among it."""
    command = [sys.executable, "-c", HOLD, tmp_path, "os.kill(os.getpid(), 9)"]
    assert subprocess.run(command).returncode == -9
    assert (tmp_path / LOCK).read_text() != str(os.getpid())
    for content in (None, "", "hello"):
        if content is not None:
            (tmp_path / LOCK).write_text(content)
        with claim_folder(tmp_path, "run"):
            assert (tmp_path / LOCK).read_text() == str(os.getpid())
        assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_locked_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / LOCK).mkdir()
    with pytest.raises(UsageError, match=f"{LOCK}: cannot be locked: Is a directory"):
        claim_folder(tmp_path, "run", overwrite=True).__enter__()
    (tmp_path / LOCK).rmdir()

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.raises(UsageError, match="cannot be locked: Function not implemented"):
        claim_folder(tmp_path, "run", overwrite=True).__enter__()


def test_files_are_written_into_folders_and_over_nothing_unasked(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("one", "two", "three")]
    for path in paths[1:]:
        path.touch()
    with pytest.raises(UsageError, match=r"/two, .*/three: already there; .* say --overwrite"):
        require_free_files(paths, may_exist=False)
    require_free_files(paths, may_exist=True)
    for folder in ("gone", "two"):
        with pytest.raises(UsageError, match=f"there is no folder .*{folder}"):
            require_free_files([tmp_path / folder / "one"], may_exist=True)
