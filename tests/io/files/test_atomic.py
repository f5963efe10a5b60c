"""Writing leaves the whole new file or the untouched old one."""

import os
from pathlib import Path

import pytest

from ddrecon.errors import FormatError
from ddrecon.io.files.atomic import replace_file, replace_file_durably


def test_the_temporary_file_lies_beside_the_final_one_and_becomes_it(tmp_path: Path):
    path = tmp_path / "a.txt"
    with replace_file(path) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".txt" and temporary != path
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("interruption", [ValueError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file(
    tmp_path: Path, interruption: type[BaseException]
):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(interruption), replace_file(path) as temporary:
        temporary.write_text("half")
        raise interruption
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("has_links", [True, False])
def test_the_file_is_there_all_the_while_it_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_links: bool
) -> None:
    """Whole at each step a crash may come after, what it was before is kept, and none is left."""
    path, kept = tmp_path / "a.txt", tmp_path / "before.txt"
    replace, seen = os.replace, []

    def look(source: Path, target: Path) -> None:
        replace(source, target)
        seen.append(path.read_text())

    def link(*_: Path) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "replace", look)
    if not has_links:
        monkeypatch.setattr(os, "link", link)
    for text in ("1", "2", "3"):
        with replace_file_durably(path, kept_as=kept) as temporary:
            temporary.write_text(text)
    assert seen == ["1", "1", "2", "2", "3"]
    assert kept.read_text() == "2" and sorted(tmp_path.iterdir()) == [path, kept]


def test_a_refusal_of_the_system_is_a_format_error(tmp_path: Path):
    path = tmp_path / "absent" / "a.txt"
    with pytest.raises(FormatError, match="cannot be written"), replace_file(path) as temporary:
        temporary.write_text("x")


def test_folders_that_cannot_be_flushed_hold_checkpoints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Windows and some network drives have them."""
    opened = os.open

    def refuse(path: Path, *rest: int, **others: int) -> int:
        if os.path.isdir(path):
            raise PermissionError
        return opened(path, *rest, **others)

    monkeypatch.setattr(os, "open", refuse)
    with replace_file_durably(tmp_path / "a", kept_as=tmp_path / "b") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a").read_text() == "new"
