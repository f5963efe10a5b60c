"""Files are written whole or not at all; a folder is one process's, and knows what it wrote."""

import errno
import json
import math
import os
import subprocess
import sys
from itertools import permutations

import pytest

from ddrecon.errors import DataWarning, FormatError, UsageError
from ddrecon.io.files.atomic import replace_file, replace_file_durably, write_json
from ddrecon.io.files.folders import (
    FILM,
    KINDS,
    LOCK,
    MANIFEST,
    RUN,
    claim_folder,
    hold,
    kind_of_folder,
    require_free_files,
)


def test_the_temporary_file_lies_beside_the_final_one_and_becomes_it(tmp_path):
    path = tmp_path / "a.txt"
    with replace_file(path) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".txt" and temporary != path
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("interruption", [ValueError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file(tmp_path, interruption):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(interruption), replace_file(path) as temporary:
        temporary.write_text("half")
        raise interruption
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("has_links", [True, False])
def test_the_file_is_there_all_the_while_it_is_replaced(tmp_path, monkeypatch, has_links):
    """Whole at each step a crash may come after, what it was before is kept, and none is left."""
    path, kept = tmp_path / "a.txt", tmp_path / "before.txt"
    replace, seen = os.replace, []

    def look(source, target):
        replace(source, target)
        seen.append(path.read_text())

    def link(*_):
        raise PermissionError

    monkeypatch.setattr(os, "replace", look)
    if not has_links:
        monkeypatch.setattr(os, "link", link)
    for text in ("1", "2", "3"):
        with replace_file_durably(path, kept_as=kept) as temporary:
            temporary.write_text(text)
    assert seen == ["1", "1", "2", "2", "3"]
    assert kept.read_text() == "2" and sorted(tmp_path.iterdir()) == [path, kept]


def test_a_refusal_of_the_system_is_a_format_error(tmp_path):
    path = tmp_path / "absent" / "a.txt"
    with pytest.raises(FormatError, match="cannot be written"), replace_file(path) as temporary:
        temporary.write_text("x")


def test_folders_that_cannot_be_flushed_hold_checkpoints(tmp_path, monkeypatch):
    """As Windows and some network drives have them."""
    opened = os.open

    def refuse(path, *rest, **others):
        if os.path.isdir(path):
            raise PermissionError
        return opened(path, *rest, **others)

    monkeypatch.setattr(os, "open", refuse)
    with replace_file_durably(tmp_path / "a", kept_as=tmp_path / "b") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a").read_text() == "new"


SCRIPT = """
import os, sys
from pathlib import Path
from ddrecon.errors import UsageError
from ddrecon.io.files.folders import claim_folder
folder = Path(sys.argv[1])
"""
HOLD = SCRIPT + "with claim_folder(folder, 'run', overwrite=True): exec(sys.argv[2])"


def test_a_second_holder_is_refused_and_told_which_process_is_the_first(tmp_path):
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


def test_what_nobody_holds_blocks_nobody(tmp_path):
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


def test_what_cannot_be_locked_is_refused(tmp_path, monkeypatch):
    (tmp_path / LOCK).mkdir()
    with pytest.raises(UsageError, match=f"{LOCK}: cannot be locked: Is a directory"):
        claim_folder(tmp_path, "run", overwrite=True).__enter__()
    (tmp_path / LOCK).rmdir()

    def refuse(*_):
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.raises(UsageError, match="cannot be locked: Function not implemented"):
        claim_folder(tmp_path, "run", overwrite=True).__enter__()


def test_files_are_written_into_folders_and_over_nothing_unasked(tmp_path):
    paths = [tmp_path / name for name in ("one", "two", "three")]
    for path in paths[1:]:
        path.touch()
    with pytest.raises(UsageError, match=r"/two, .*/three: already there; .* say --overwrite"):
        require_free_files(paths, may_exist=False)
    require_free_files(paths, may_exist=True)
    for folder in ("gone", "two"):
        with pytest.raises(UsageError, match=f"there is no folder .*{folder}"):
            require_free_files([tmp_path / folder / "one"], may_exist=True)


def fill(path, kind, *names):
    """Has a job of a `kind` write files of these `names` in `path`."""
    with claim_folder(path, kind, overwrite=True):
        for name in names:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            write_json(path / name, name)


def contents(folder):
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def test_what_is_removed_is_what_was_written(tmp_path):
    fill(tmp_path, RUN, "a", "deep/er/b", "deep/c", "kept")
    fill(tmp_path, RUN, "later")  # the manifest grows
    (tmp_path / "deep/mine").write_text("mine")
    (tmp_path / MANIFEST).open("a").write("deep/mine")  # torn: its line never ended
    with claim_folder(tmp_path, RUN, overwrite=True) as folder:
        folder.clear([tmp_path / "deep/../kept"])
    assert set(contents(tmp_path)) == {MANIFEST, "deep/mine", "kept"}
    assert not (tmp_path / "deep/er").exists()
    with claim_folder(tmp_path, RUN, overwrite=True) as folder:
        folder.clear()
    assert set(contents(tmp_path)) == {MANIFEST, "deep/mine"}


def assert_refused(path, kind, text, *ways):
    """No job of this `kind` begins in the folder `path`, in whatever way, and nothing changes."""
    before = contents(path)
    for way in ways:
        with pytest.raises(UsageError, match=text), claim_folder(path, kind, **way):
            pass
    assert contents(path) == before


@pytest.mark.parametrize(("there", "kind"), [*permutations(KINDS, 2)])
def test_a_folder_of_another_kind_is_refused(tmp_path, there, kind):
    fill(tmp_path, there, "report.html")
    text = f"another kind of job, {there}; choose another folder"
    assert_refused(tmp_path, kind, text, {"overwrite": True}, {"resume": True}, {})


def test_a_folder_of_others_is_refused(tmp_path):
    (tmp_path / "scene.yaml").write_text("mine")
    (tmp_path / MANIFEST).write_text("ddrecon strange\nscene.yaml\n")
    assert_refused(tmp_path, RUN, "holds scene.yaml, which ddrecon did not", {})
    assert_refused(
        tmp_path, RUN, "manifest says who wrote scene.yaml; if ddrecon", {"resume": True}
    )


def test_a_folder_whose_manifest_is_lost_goes_on_as_the_refusal_says(tmp_path):
    fill(tmp_path, RUN, "a")
    (tmp_path / MANIFEST).unlink()
    with pytest.raises(UsageError) as refused, claim_folder(tmp_path, RUN, resume=True):
        pass
    (tmp_path / MANIFEST).write_text(str(refused.value).split("`")[1] + "\n")
    with claim_folder(tmp_path, RUN, resume=True):
        pass
    assert (tmp_path / "a").is_file()


def test_a_manifest_names_nothing_outside(tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("mine")
    fill(tmp_path / "run", RUN, "a")
    with (tmp_path / "run" / MANIFEST).open("a") as stream:
        stream.write(f"../secret\n{secret}\na/../../secret\n")
    with claim_folder(tmp_path / "run", RUN, overwrite=True) as folder:
        folder.clear()
    assert contents(tmp_path) == {"secret": b"mine"}


def test_a_file_of_others_steps_aside(tmp_path):
    """Where a job comes to write one of its name, amid its own."""
    fill(tmp_path, RUN, "a")
    for number in (1, 2):
        (tmp_path / "report.html").write_text(str(number))
        (tmp_path / MANIFEST).write_text(f"ddrecon {RUN}\na\n")
        with pytest.warns(DataWarning, match=rf"not written by ddrecon; now report.{number}.html"):
            fill(tmp_path, RUN, "report.html")
        assert (tmp_path / f"report.{number}.html").read_text() == str(number)


def test_folders_within_are_removed_by_part(tmp_path):
    """By their own manifests, and none of them while another process writes to one."""
    with claim_folder(tmp_path, FILM):
        write_json(tmp_path / "film.json", 0)
        for number in range(3):
            fill(tmp_path / f"frames/{number}", RUN, "volumes/a")
    (tmp_path / "frames/2/mine").write_text("mine")
    with claim_folder(tmp_path, FILM, overwrite=True) as folder:
        folder.clear(beginnings=["frames/1/"])
    names = {MANIFEST, "film.json", "frames/2/mine"}
    names |= {f"frames/{n}/{name}" for n in (0, 2) for name in (MANIFEST, "volumes/a")}
    assert set(contents(tmp_path)) == names and not (tmp_path / "frames/1").exists()
    with (
        hold(tmp_path / "frames/2" / LOCK),
        claim_folder(tmp_path, FILM, overwrite=True) as folder,
        pytest.raises(UsageError, match=r"frames/2: process .* is writing there"),
    ):
        folder.clear()
    assert set(contents(tmp_path)) == names
    with claim_folder(tmp_path, FILM, overwrite=True) as folder:
        folder.clear()
    assert set(contents(tmp_path)) == {
        MANIFEST,
        *(f"frames/2/{name}" for name in (MANIFEST, "mine")),
    }


def test_where_nothing_was_written_no_folder_is_left(tmp_path):
    with pytest.raises(ZeroDivisionError), claim_folder(tmp_path / "a/b", RUN):
        raise ZeroDivisionError
    assert not any(tmp_path.iterdir())
    with pytest.raises(ZeroDivisionError), claim_folder(tmp_path / "a/b", RUN):
        write_json(tmp_path / "a/b/kept", 0)
        raise ZeroDivisionError
    assert kind_of_folder(tmp_path / "a/b") == RUN


def test_json_is_read_by_whoever_keeps_to_its_rules(tmp_path):
    """Numbers that are not finite, which Python alone would read, are null."""
    content = {"worst": [math.inf, -math.inf, math.nan, 1e300], "name": "NaN"}
    write_json(tmp_path / "a.json", content)
    read = json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail)
    assert read == {"worst": [None, None, None, 1e300], "name": "NaN"}
