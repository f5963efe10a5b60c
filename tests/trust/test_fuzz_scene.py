"""Strangers' scene files are taken or refused in lines that name the place, at once."""

# ruff: noqa: RUF001, SIM905

import os
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from deadline import deadline
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ddrecon.cli.commands import main
from ddrecon.io.volumes.table import write_field
from ddrecon.scene_file.load import MAX_BYTES

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("untimed")]

SCENE = """
volume:
  bounds: {min: [-0.5, -0.5, -0.5], max: [0.5, 0.5, 0.5]}
  resolution: [6, 5, 4]
  density: {file: density.npz}
  sigma_t: 2
  albedo: [0.5, 0.6, 0.7]
  g: 0.3
lights:
  - {type: directional, direction: [-1, -2, -1], irradiance: 3}
  - {type: ambient, radiance: [0.1, 0.2, 0.3]}
  - {type: environment, file: front.npy, scale: 1, rotation: 10, directions: 6}
  - {type: point, position: [0, 2, 0], intensity: 5}
render: {samples_per_pixel: 1, background: true, tolerance: 0.05}
diffusion: {model: p1, closure: geometric, tolerance: 1e-4, transport_rounds: 1}
optimize:
  iterations: 4
  loss: l2
  parameters:
    density: {init: 0, min: 0}
    g: {init: 0.1}
    lights.0.irradiance: {init: [1, 2, 3]}
    views.front.camera: {}
"""
VIEWS = """
views:
  - name: front
    image: front.npy
    camera: {type: perspective, origin: [0, 0, 2.5], target: [0, 0, 0], up: [0, 1, 0], fov: 30,
             resolution: [8, 6]}
  - name: side
    split: test
    mask: front.npy
    weight: 2
    camera: {type: orthographic, width: 1, resolution: [8, 6],
             matrix: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.5], [0, 0, 0, 1]]}
"""
RING = """
views:
  ring: {count: 2, radius: 2.5, height: 0.1, fov: 30, resolution: [8, 6]}
  images: "*o*.npy"
"""
SCENES = SCENE + VIEWS, SCENE.replace("    views.front.camera: {}\n", "") + RING
"""With something of everything."""
STRANGE = [
    *"0 -0.0 -1 2 3.5 1e-45 1e-300 1e38 -1e38 1e999 -1e999 .nan .inf 0o17 4096 1_000 --1".split(),
    *"16384 0x7fffffffffffffff 9223372036854775808 9999999999999999999 179.99999 1e 1.2.3".split(),
    *"~ null true no soon ü 𝔘𝔫𝔦 \u202e /dev/zero /dev/stdin pipe.npy pipe.npz loop.npy".split(),
    *"folder.npy link.npy gone.npz front.npy density.npz scene.yaml perspective *a | << é".split(),
    *"density file type g init sigma_a matrix ring views.side.camera lights.9.scale".split(),
    *("", '""', '"\\0"', '"\\ud83d"', '"a\\nb"', "a" * 5000, '"' + "../" * 50 + 'etc/passwd"'),
    *('"/*/*/*/*"', '"**/*"', "!!python/name:os.system x", "&a 1", "? a", "- b", "@", "`", "{"),
    *("%TAG", "[", "]", "}", "{a: b", "'", '"', "#", ": :", "\t", "\x07", "\x85", "\ufeff", "\n"),
    *("[" * 40 + "]" * 40, "{a: " * 40 + "}" * 40, "[" * 2000, "{a: " * 2000),
    *"[1, 2]; [1, 2, 3]; [0, 0, 0]; [[1, 2, 3]]; []; {}; [null]; {ring: {}}".split("; "),
    *"{file: pipe.npz}; {file: density.npz}; {file: folder.npy}; {constant: -1}".split("; "),
    *"{constant: 1}; [.nan, 1, 2]; [4096, 4096, 64]; [1024, 1024, 1024]".split("; "),
    *"[1e38, 1e38, 1e38]; [-1e38, 1e-38, 0]".split("; "),
]
VALUES = st.one_of(st.sampled_from(STRANGE), st.floats().map(repr), st.text(max_size=12))
LEFT_OUT = [HealthCheck.function_scoped_fixture]
CASES = settings(derandomize=True, database=None, max_examples=60, suppress_health_check=LEFT_OUT)
PLACE = re.compile(r"(scene\.yaml(:\d+:\d+)?|-D |and more: |/).*")
"""How every line begins: the place in the scene or override, or the path of a data file."""


@st.composite
def damaged(draw):
    """A scene with a few of its words replaced, removed or added; not always UTF-8."""
    words = re.findall(r"[\w.+-]+|.|\n", draw(st.sampled_from(SCENES)))
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(words)))
        words[start : start + draw(st.sampled_from([0, 1, 1, 1, 2, 30, 100000]))] = [draw(VALUES)]
    data = "".join(words).encode("utf-8", "surrogatepass")
    place = draw(st.integers(0, len(data)))
    return data[:place] + draw(st.sampled_from([b""] * 4 + [b"\xff", b"\x80\0"])) + data[place:]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with the files that scenes name: good ones, a pipe, a loop, a folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("front.npy", "to.npy"):
        np.save(name, np.full((6, 8, 3), 0.75, np.float32))
    box, values = np.array([[-0.5] * 3, [0.5] * 3]), np.random.default_rng(0).random((4, 5, 6))
    write_field(Path("density.npz"), "density", values, box)
    for name in ("pipe.npy", "pipe.npz"):
        os.mkfifo(name)
    os.symlink("loop.npy", "loop.npy")
    os.symlink("front.npy", "link.npy")
    Path("folder.npy").mkdir()
    return tmp_path


def require_taken_or_refused(folder, *arguments):
    """The exit code, 0, 2 or 3, of a command that ends at once, names the place, writes nothing."""
    before = {*folder.rglob("*")}
    with deadline(5.0):
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


@pytest.mark.parametrize("scene", SCENES, ids=["views", "ring"])
def test_the_scene_itself_is_taken(folder, scene):
    Path("scene.yaml").write_text(scene)
    assert require_taken_or_refused(folder, "check", "scene.yaml") == 0


@settings(CASES, max_examples=120)
@given(data=damaged())
def test_changed_words(folder, data):
    Path("scene.yaml").write_bytes(data)
    require_taken_or_refused(folder, "check", "scene.yaml")


@CASES
@given(
    path=st.sampled_from(re.findall(r"[\w.]+(?=:)", SCENES[0])) | VALUES,
    owner=st.sampled_from(["", "volume.", "lights.0.", "views.1.camera.", "diffusion.", "render."]),
    value=VALUES,
    extra=st.sampled_from(["", ".x", ".0", ".0.0", "." + ".".join("a" * 500)]),
)
def test_overrides(folder, owner, path, value, extra):
    Path("scene.yaml").write_text(SCENES[0])
    require_taken_or_refused(folder, "check", "scene.yaml", "-D", f"{owner}{path}{extra}={value}")


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
    "too large": SCENES[0] + "#" * MAX_BYTES,
}


@pytest.mark.parametrize("kind", LARGE)
def test_large_scenes(folder, kind):
    Path("scene.yaml").write_text(LARGE[kind])
    assert require_taken_or_refused(folder, "check", "scene.yaml") == 2


@pytest.mark.timeout(60)
@pytest.mark.parametrize(
    "scene", ["pipe.npy", "loop.npy", "folder.npy", "/dev/zero", "/dev/stdin", "a\nb", "a" * 300]
)
def test_what_is_no_scene_file(folder, scene):
    result = CliRunner().invoke(main, ["check", scene])
    assert (result.exit_code, result.stdout) == (2, "") and len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith(scene.replace("\n", "\\n"))
