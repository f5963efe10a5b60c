"""Strict YAML: what a scalar means, and what text is refused, with its line and column."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ddrecon.errors import Problems, SceneError
from ddrecon.scene_file.load import MAX_BYTES, read_scene
from ddrecon.scene_file.read import parse, resolve

WHOLE = {"010": 10, "-7": -7}
WORDS = {"true": True, "False": False, "null": None, "~": None, "": None, ".inf": math.inf}
WORDS["9" * 10_000] = math.inf  # no integer
PLAIN = {text: float(text) for text in ["1e-3", "1E5", "-.5", "+3.", "1e+05"]} | WHOLE | WORDS
PLAIN |= {
    text: text
    for text in ["yes", "no", "on", "1_000", "0x1F", "0o17", "1:30", "1e", ".", "2020-01-01"]
}


@pytest.mark.parametrize(("text", "value"), PLAIN.items())
def test_plain_scalars_follow_yaml_1_2(text, value):
    assert resolve(text) == value and type(resolve(text)) is type(value)


@given(st.floats(allow_nan=False))
def test_every_float_is_read_as_python_or_json_writes_it(number):
    if math.isfinite(number):
        assert resolve(repr(number)) == number


TREE = """
lens: {fov: 30, size: [8, 6]}
views:
  - {name: &a a, "at": '1e3', camera: {size: [8, 6], fov: 40}}
"""


def test_a_tree_is_what_yaml_says_and_nodes_know_their_places():
    root = parse(TREE, lambda line, column: f"{line}:{column}", Problems())
    leaves = {node.key: (node.value, node.where) for node in root.walk() if not node.children()}
    expected = [(30, "2:13"), (8, "2:24"), (6, "2:27"), ("a", "4:12")]
    expected += [("1e3", "4:24"), (8, "4:47"), (6, "4:50"), (40, "4:59")]
    assert [*leaves.values()] == expected
    assert [*leaves][-2:] == ["views.0.camera.size.1", "views.0.camera.fov"]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a: &x 1\nb: [*x]\n", "scene.yaml:2:5: aliases such as *name are not supported"),
        ("a: !!python/name:os.system x\n", "scene.yaml:1:4: tags such as 'tag:yaml.org,2002:py"),
        ("a: 1\n---\nb: 2\n", "scene.yaml:2:1: not YAML: expected a single document"),
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
def test_what_is_not_strict_yaml_is_refused_in_one_line(refusal, text, line):
    (problem_line,) = refusal(text)
    assert line in problem_line


def test_deep_nesting_is_refused_not_a_crash(refusal):
    (line,) = refusal("[" * 20_000)
    assert "nested more than 32 deep" in line


def test_repeated_and_empty_keys_are_found_at_every_level(refusal):
    lines = refusal("volume: {g: 0, g: 1, '': 1}\nlights: []\nlights: []\n")
    assert lines[0] == "scene.yaml:1:16: volume.g: repeated key; it is already at scene.yaml:1:10"
    assert lines[1] == "scene.yaml:3:1: lights: repeated key; it is already at scene.yaml:2:1"
    assert any(line.startswith("scene.yaml:1:22: volume.'': unknown key") for line in lines)


def test_absent_large_and_binary_files_are_refused(tmp_path):
    def problem(path):
        with pytest.raises(SceneError) as caught:
            read_scene(path)
        return str(caught.value)

    fault = "a.yaml: cannot be read: No such file or directory"
    assert problem(tmp_path / "a.yaml").endswith(fault)
    assert "cannot be read" in problem(tmp_path)
    for size in (MAX_BYTES + 1, 2**40):  # of which no more is read than tells
        with (tmp_path / "b.yaml").open("wb") as stream:
            stream.truncate(size)
        fault = f"b.yaml:1:{MAX_BYTES + 1}: is larger than 1 MiB"
        assert fault in problem(tmp_path / "b.yaml")
    (tmp_path / "c.yaml").write_bytes(b"a: 1\nb: \xff\n")
    assert problem(tmp_path / "c.yaml").endswith("c.yaml:2:4: is not UTF-8 text")
