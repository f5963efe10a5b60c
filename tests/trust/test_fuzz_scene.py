"""Strangers' scene files are taken or refused in lines that name the place, at once."""

import copy
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from deadline import deadline
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from strange_scene import KEYS, NESTED, RING, SCENE, VALUES, WORDS

from ddrecon.cli.commands import main
from ddrecon.io.volumes.table import write_field
from ddrecon.scene_file.load import MAX_BYTES

pytestmark = pytest.mark.slow

LEFT_OUT = [HealthCheck.function_scoped_fixture]
CASES = settings(derandomize=True, database=None, max_examples=60, suppress_health_check=LEFT_OUT)
PLACE = re.compile(r"(scene\.yaml(:\d+:\d+)?|-D |and more: |/).*")
"""How every line begins: the place in the scene or override, or the path of a data file."""


def in_a_ring(scene: dict[str, Any]) -> dict[str, Any]:
    """`scene` with a ring of views, and so without the parameter of one of its own cameras."""
    scene = copy.deepcopy({**scene, "views": RING})
    del scene["optimize"]["parameters"]["views.front.camera"]
    return scene


def places(tree: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path of everything in `tree` but its root."""
    entries: Any = tree.items() if isinstance(tree, dict) else ()
    entries = enumerate(tree) if isinstance(tree, list) else entries
    return [path for key, value in entries for path in [(*here, key), *places(value, (*here, key))]]


def flow(tree: Any) -> str:
    """`tree` as YAML in flow style, what is text in it as it stands."""
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{key}: {flow(value)}" for key, value in tree.items()) + "}"
    return "[" + ", ".join(map(flow, tree)) + "]" if isinstance(tree, list) else str(tree)


def block(tree: dict[str, Any]) -> str:
    return "".join(f"{key}: {flow(value)}\n" for key, value in tree.items())


@st.composite
def trees(draw: Callable[..., Any]) -> str:
    """The scene with a few of its values, keys or sections replaced, removed, added or doubled."""
    tree = in_a_ring(SCENE) if draw(st.booleans()) else copy.deepcopy(SCENE)
    for _ in range(draw(st.integers(1, 3))):
        paths = places(tree)
        *above, last = paths[draw(st.integers(0, len(paths) - 1))]
        parent = tree
        for key in above:
            parent = parent[key]
        what = draw(st.sampled_from(["replace", "replace", "replace", "remove", "add", "double"]))
        if what == "replace":
            parent[last] = draw(VALUES)
        elif what == "remove":
            del parent[last]
        elif isinstance(parent, dict):
            parent[draw(KEYS) if what == "add" else f"{last}: 1, {last}"] = draw(VALUES)
        else:
            parent.append(draw(VALUES) if what == "add" else parent[last])
        if not tree:
            break
    return block(tree)


@st.composite
def texts(draw: Callable[..., Any]) -> bytes:
    """The scene's text, cut off or with characters changed, removed or added; not always UTF-8."""
    data = bytearray(block(SCENE).encode())
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        end = start + draw(st.sampled_from([0, 0, 1, 1, 2, 30, 100000]))
        words = st.sampled_from(WORDS + NESTED).map(str.encode)
        data[start:end] = draw(
            st.one_of(words, st.binary(max_size=4), st.sampled_from([b"\n", b": "]))
        )
    return bytes(data)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with the files that scenes name: good ones, a pipe, a loop, a folder."""
    monkeypatch.chdir(tmp_path)
    np.save("front.npy", np.full((6, 8, 3), 0.75, np.float32))
    np.save("to.npy", np.full((6, 8, 3), 0.75, np.float32))
    box, values = np.array([[-0.5] * 3, [0.5] * 3]), np.random.default_rng(0).random((4, 5, 6))
    write_field(Path("density.npz"), "density", values, box)
    os.mkfifo("pipe.npy")
    os.mkfifo("pipe.npz")
    os.symlink("loop.npy", "loop.npy")
    os.symlink("front.npy", "link.npy")
    Path("folder.npy").mkdir()
    return tmp_path


def files_below(folder: Path) -> set[str]:
    """Every name below `folder`."""
    return {
        os.path.join(where, name)
        for where, folders, names in os.walk(folder)
        for name in (*folders, *names)
    }


def require_taken_or_refused(folder: Path, *arguments: str) -> int:
    """The exit code, 0, 2 or 3, of a command that ends at once, names the place, writes nothing."""
    before = {*folder.rglob("*")}
    with deadline():
        result = CliRunner().invoke(main, list(arguments))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code in (0, 2, 3), result.output
    assert {*folder.rglob("*")} == before
    if result.exit_code:
        assert result.stdout == ""
        lines = [one for one in result.stderr.split("\n")[:-1] if not one.startswith("warning: ")]
        assert lines and all(PLACE.fullmatch(line) and len(line) <= 1100 for line in lines), lines
    return result.exit_code


def test_the_scene_itself_is_taken(folder: Path) -> None:
    for scene in (SCENE, in_a_ring(SCENE)):
        Path("scene.yaml").write_text(block(scene))
        assert require_taken_or_refused(folder, "check", "scene.yaml") == 0


@CASES
@given(text=trees())
def test_changed_keys_and_values(folder: Path, text: str) -> None:
    Path("scene.yaml").write_text(text, encoding="utf-8", errors="surrogatepass")
    require_taken_or_refused(folder, "check", "scene.yaml")


@CASES
@given(data=texts())
def test_changed_characters(folder: Path, data: bytes) -> None:
    Path("scene.yaml").write_bytes(data)
    require_taken_or_refused(folder, "check", "scene.yaml")


@CASES
@given(
    path=st.sampled_from([".".join(map(str, path)) for path in places(SCENE)]) | KEYS,
    value=VALUES,
    extra=st.sampled_from(["", ".x", ".0", ".0.0", "." + ".".join("a" * 500)]),
)
def test_overrides(folder: Path, path: str, value: str, extra: str) -> None:
    Path("scene.yaml").write_text(block(SCENE))
    require_taken_or_refused(folder, "check", "scene.yaml", "-D", f"{path}{extra}={value}")


LARGE = {
    "aliases": "a: &a [x]\nb: [" + "*a, " * 60_000 + "*a]",
    "nested lists": "volume: " + "[" * 500_000,
    "nested mappings": "{a: " * 200_000,
    "nested blocks": "".join(" " * i + "a:\n" for i in range(1000)),
    "unknown keys": "".join(f"kee{i}: 1\n" for i in range(20_000)),
    "repeated keys": "render: {}\n" * 20_000,
    "views": "views:\n" + "- {camera: {}}\n" * 15_000,
    "views of one name": "views:\n" + "- {name: a, camera: 1}\n" * 10_000,
    "one long key": "a" * 1_000_000 + ": 1",
    "one long value": "volume: " + "a" * 1_000_000,
    "one long number": "volume: " + "9" * 1_000_000,
    "one long list": "views: [" + "1," * 60_000 + "1]",
    "broken at its end": "views:\n" + "- {camera: {}}\n" * 15_000 + "]",
    "too large": "#" * (MAX_BYTES + 1),
}


@pytest.mark.parametrize("kind", LARGE)
def test_large_scenes(folder: Path, kind: str) -> None:
    Path("scene.yaml").write_text(LARGE[kind])
    assert require_taken_or_refused(folder, "check", "scene.yaml") == 2


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "scene", ["pipe.npy", "loop.npy", "folder.npy", "/dev/zero", "/dev/stdin", "a\nb", "a" * 300]
)
def test_what_is_no_scene_file(folder: Path, scene: str) -> None:
    result = CliRunner().invoke(main, ["check", scene])
    assert (result.exit_code, result.stdout) == (2, "") and len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith(scene.replace("\n", "\\n"))
