"""Files are written where nothing is, unless it may be replaced, and only into existing folders."""

from __future__ import annotations

from pathlib import Path

import pytest

from ddrecon.errors import UsageError
from ddrecon.io.files.folders import require_free_files


def test_a_free_name_in_a_folder_is_fine(tmp_path: Path) -> None:
    require_free_files([tmp_path / "one", tmp_path / "two"], may_exist=False)


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
