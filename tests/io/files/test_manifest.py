"""A folder knows what was written there by which kind of job; all else stays as it is."""

from itertools import permutations
from pathlib import Path

import pytest

from ddrecon.errors import DataWarning, UsageError
from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.folders import (
    FILM,
    KINDS,
    LOCK,
    MANIFEST,
    RUN,
    claim_folder,
    hold,
    kind_of_folder,
)


def fill(path: Path, kind: str, *names: str) -> None:
    """Has a job of a `kind` write files of these `names` in `path`."""
    with claim_folder(path, kind, overwrite=True):
        for name in names:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            write_json(path / name, name)


def contents(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def test_what_is_removed_is_what_was_written(tmp_path: Path) -> None:
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


@pytest.mark.parametrize(("there", "kind"), [*permutations(KINDS, 2)])
def test_a_folder_of_another_kind_is_refused(tmp_path: Path, there: str, kind: str) -> None:
    fill(tmp_path, there, "report.html")
    before = contents(tmp_path)
    for how in ({"overwrite": True}, {"resume": True}, {}):
        with (
            pytest.raises(UsageError, match=f"another kind of job, {there}; choose another folder"),
            claim_folder(tmp_path, kind, **how),
        ):
            pass
    assert contents(tmp_path) == before


def test_a_folder_of_others_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text("mine")
    (tmp_path / MANIFEST).write_text("ddrecon strange\nscene.yaml\n")
    before = contents(tmp_path)
    for how in ({"resume": True}, {}):
        with (
            pytest.raises(UsageError, match=r"holds scene.yaml, which ddrecon did not write"),
            claim_folder(tmp_path, RUN, **how),
        ):
            pass
    assert contents(tmp_path) == before


def test_a_manifest_names_nothing_outside(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("mine")
    fill(tmp_path / "run", RUN, "a")
    with (tmp_path / "run" / MANIFEST).open("a") as stream:
        stream.write(f"../secret\n{secret}\na/../../secret\n")
    with claim_folder(tmp_path / "run", RUN, overwrite=True) as folder:
        folder.clear()
    assert contents(tmp_path) == {"secret": b"mine"}


def test_a_file_of_others_steps_aside(tmp_path: Path) -> None:
    """Where a job comes to write one of its name, amid its own."""
    fill(tmp_path, RUN, "a")
    for number in (1, 2):
        (tmp_path / "report.html").write_text(str(number))
        (tmp_path / MANIFEST).write_text(f"ddrecon {RUN}\na\n")
        with pytest.warns(DataWarning, match=rf"not written by ddrecon; now report.{number}.html"):
            fill(tmp_path, RUN, "report.html")
        assert (tmp_path / f"report.{number}.html").read_text() == str(number)


def test_folders_within_are_removed_by_part(tmp_path: Path) -> None:
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


def test_where_nothing_was_written_no_folder_is_left(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), claim_folder(tmp_path / "a/b", RUN):
        raise ZeroDivisionError
    assert not any(tmp_path.iterdir())
    with pytest.raises(ZeroDivisionError), claim_folder(tmp_path / "a/b", RUN):
        write_json(tmp_path / "a/b/kept", 0)
        raise ZeroDivisionError
    assert kind_of_folder(tmp_path / "a/b") == RUN
