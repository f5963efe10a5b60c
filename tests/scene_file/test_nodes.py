"""Strict YAML: what a scalar means, and what text is refused, with its line and column."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ddrecon.errors import Problems, SceneError
from ddrecon.scene_file.load import MAX_BYTES, read_scene
from ddrecon.scene_file.nodes import Node, parse, resolve

Refusal = Callable[..., list[str]]


WHOLE = {"010": 10, "0x1F": 31, "0o17": 15, "-7": -7}
WORDS = {"true": True, "False": False, "null": None, "~": None, "": None, ".inf": math.inf}
PLAIN = {text: float(text) for text in ["1e-3", "1E5", "-.5", "+3.", "1e+05"]} | WHOLE | WORDS
PLAIN |= {text: text for text in ["yes", "no", "on", "1_000", "1:30", "1e", ".", "2020-01-01"]}


@pytest.mark.parametrize(("text", "value"), PLAIN.items())
def test_plain_scalars_follow_yaml_1_2(text: str, value: object):
    assert resolve(text) == value and type(resolve(text)) is type(value)


def test_long_digit_strings_are_not_integers():
    assert resolve("9" * 10_000) == math.inf


@given(st.floats(allow_nan=False))
def test_every_float_is_read_as_python_or_json_writes_it(number: float):
    if math.isfinite(number):
        assert resolve(repr(number)) == number


def value_of(text: str) -> object:
    return parse(text, lambda line, column: f"{line}:{column}", Problems()).value


def test_quoted_scalars_are_text():
    assert value_of('"1e3"') == "1e3"
    assert value_of("'true'") == "true"
    assert value_of('{\n\t"a": "\\u0041"\n}')["a"].value == "A"


def plain(node: Node) -> object:
    """What `node` and all below it hold, as Python has it; keys are checked."""
    if isinstance(node.value, dict):
        for name, child in node.value.items():
            assert child.key == node.child_key(name)
        return {name: plain(child) for name, child in node.value.items()}
    if isinstance(node.value, list):
        for index, child in enumerate(node.value):
            assert child.key == node.child_key(index)
        return [plain(child) for child in node.value]
    return node.value


ALIASED = """
lens: &lens {fov: 30, size: &size [8, 6]}
views:
  - {name: a, camera: *lens}
  - {name: b, camera: {size: *size, fov: 40}}
"""


def test_aliases_mean_what_yaml_says():
    """As PyYAML has them; keys lead to where they are used, places to where they are written."""
    root = parse(ALIASED, lambda line, column: f"{line}:{column}", Problems())
    assert plain(root) == yaml.safe_load(ALIASED)
    marks = {node.key: node.where for node in root.walk()}
    assert marks["views.0.camera"] == "2:7" and marks["views.0.camera.fov"] == "2:19"
    assert marks["views.1.camera.fov"] == "5:42" and marks["views.1.camera.size.1"] == "2:39"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a: 1\nb: [*x]\n", "scene.yaml:2:5: not YAML: found undefined alias"),
        ("a: &x [*x]\n", "nested more than 32 deep"),
        ("a: &x [" + "0, " * 5000 + "0]\nb: [" + "*x, " * 20 + "0]\n", "more than 100,000 values"),
        ("a: !!python/name:os.system x\n", "scene.yaml:1:4: a: tags such as 'tag:yaml.org,2002:py"),
        (
            "a: 1\n---\nb: 2\n",
            "scene.yaml:2:1: not YAML: expected a single document in the stream, ",
        ),
        ("? [a]\n: 1\n", "scene.yaml:1:3: ?: a key must be plain text"),
        ("a: [1,\n", "scene.yaml:2:1: not YAML: while parsing a flow node, "),
        ("a: 1\n\tb: 2\n", "scene.yaml:2:1: not YAML: while scanning "),
        ("a: 1\nb: \x01\n", "scene.yaml:2:4: not YAML: the character 1 is not allowed"),
        ("", "scene.yaml:1:1: is empty"),
        ("# nothing\n---\n", "scene.yaml:3:1: is empty"),
        ("[1, 2]", "scene.yaml:1:1: expected a mapping, found a list of 2"),
        ("hello", "scene.yaml:1:1: expected a mapping, found 'hello'"),
    ],
)
def test_what_is_not_strict_yaml_is_refused_in_one_line(refusal: Refusal, text: str, line: str):
    (found,) = refusal(text)
    assert line in found


def test_deep_nesting_is_refused_not_a_crash(refusal: Refusal):
    (line,) = refusal("[" * 20_000)
    assert "nested more than 32 deep" in line


def test_repeated_keys_are_found_at_every_level(refusal: Refusal):
    lines = refusal("volume: {g: 0, g: 1}\nlights: []\nlights: []\n")
    assert lines[0] == "scene.yaml:1:16: volume.g: repeated key; it is already at scene.yaml:1:10"
    assert lines[1] == "scene.yaml:3:1: lights: repeated key; it is already at scene.yaml:2:1"


def test_absent_large_and_binary_files_are_refused(tmp_path: Path):
    def problem(path: Path) -> str:
        with pytest.raises(SceneError) as caught:
            read_scene(path)
        return str(caught.value)

    told = "a.yaml: cannot be read: No such file or directory"
    assert problem(tmp_path / "a.yaml").endswith(told)
    assert "cannot be read" in problem(tmp_path)
    for size in (MAX_BYTES + 1, 2**40):  # of which no more is read than tells
        with (tmp_path / "b.yaml").open("wb") as stream:
            stream.truncate(size)
        assert "larger than 1 MiB" in problem(tmp_path / "b.yaml")
    (tmp_path / "c.yaml").write_bytes(b"a: 1\nb: \xff\n")
    assert problem(tmp_path / "c.yaml").endswith("c.yaml:2:4: is not UTF-8 text")
