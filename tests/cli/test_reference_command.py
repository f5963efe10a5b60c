"""What `ddrecon reference` writes and says."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from small_scene import contents

Run = Callable[..., Result]
Refuse = Callable[..., list[str]]
REFERENCE = ["reference", "scene.yaml", "-o", "out", "-q", "--spp", "8"]
NEEDED = "the reference needs Mitsuba 3 (the extra `reference`)"


def pixels(name: str) -> np.ndarray:
    return np.load(f"out/{name}.npy", allow_pickle=False)


def test_theirs_ours_and_the_difference(succeed: Run) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    result = succeed(*REFERENCE)
    for name in ("front", "side"):
        theirs, ours, difference = (
            pixels(f"{name}.{kind}") for kind in ("reference", "ours", "difference")
        )
        assert theirs.shape == ours.shape == (6, 8, 3)
        np.testing.assert_allclose(ours - theirs, difference, atol=1e-6)
        assert (Path("out") / f"{name}.comparison.png").is_file()
        (line,) = [line for line in result.stdout.splitlines() if line.startswith(f"{name}: ")]
        assert "relative RMS error" in line and "PSNR" in line


def test_the_report(succeed: Run) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    result = succeed(*REFERENCE, "--json")
    report = json.loads(Path("out/reference.json").read_text())
    assert json.loads(result.stdout) == report
    assert {file for files in report["files"].values() for file in files} | {
        "reference.json"
    } == set(contents(Path("out")))
    assert report["settings"]["samples_per_pixel"] == 8 and report["settings"]["passes"] >= 4
    assert report["environment"]["mitsuba"] and report["environment"]["ddrecon"]
    for name, view in report["views"].items():
        theirs, ours = (pixels(f"{name}.{kind}").astype(float) for kind in ("reference", "ours"))
        mean = np.square(theirs).mean()
        assert view["distance"] == pytest.approx(
            np.sqrt(np.square(ours - theirs).mean() / mean), rel=1e-4
        )
        assert view["error"] == pytest.approx(
            np.sqrt(max(0, view["distance"] ** 2 - view["noise"] ** 2)), abs=1e-9
        )
        assert view["psnr"] == pytest.approx(
            10 * np.log10(theirs.max() ** 2 / np.square(ours - theirs).mean()), abs=1e-2
        )
        assert view["brightness"] == pytest.approx(ours.mean() / theirs.mean(), rel=1e-4)


def test_ours_is_what_render_makes(succeed: Run) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    succeed(*REFERENCE, "--view", "side")
    assert not list(Path("out").glob("front*"))
    succeed("render", "scene.yaml", "-o", "rendered", "-q")
    np.testing.assert_array_equal(
        pixels("side.ours"), np.load("rendered/side.npy", allow_pickle=False)
    )


def test_views_are_targets(succeed: Run) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    succeed(*REFERENCE, "--views")
    assert {name.partition(".")[0] for name in contents(Path("out"))} == {
        "front",
        "side",
        "reference",
    }
    assert all(name.count(".") == 1 for name in contents(Path("out")))
    targets = ["-D", "views.0.image=out/front.npy", "-D", "views.1.image=out/side.png"]
    succeed("optimize", "scene.yaml", "-o", "run", "-q", "--iterations", "1", *targets)
    succeed("render", "scene.yaml", "-o", "rendered", "-q")


def test_seeds_choose_paths(succeed: Run) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    images = []
    for seed in ("0", "0", "-1"):
        succeed(*REFERENCE, "--views", "--view", "front", "--overwrite", "--seed", seed)
        images.append(pixels("front"))
    assert np.array_equal(images[0], images[1]) and not np.array_equal(images[0], images[2])


def test_without_mitsuba(refuse: Refuse, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    assert refuse(3, *REFERENCE) == [
        'the reference renderer needs mitsuba: pip install "ddrecon[reference]"'
    ]


def test_a_folder_with_something_in_it(refuse: Refuse) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    Path("out").mkdir()
    Path("out/notes.txt").write_text("mine")
    assert refuse(2, *REFERENCE) == [
        "out: the folder is not empty; choose another, or say --overwrite"
    ]


def test_what_mitsuba_cannot_show(refuse: Refuse) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    np.save("sky.npy", np.ones((2, 4, 3), np.float32))
    maps = "lights=[{type: environment, file: sky.npy}, {type: environment, file: sky.npy}]"
    (line,) = refuse(2, *REFERENCE, "-D", maps)
    assert "2 environment maps" in line


def test_unknown_view(refuse: Refuse) -> None:
    assert refuse(2, *REFERENCE, "--view", "back") == [
        "--view back: no such view; known: front, side"
    ]


@pytest.mark.parametrize("spp", ["3", "0", "many"])
def test_usage(refuse: Refuse, spp: str) -> None:
    assert refuse(2, "reference", "scene.yaml", "-o", "out", "--spp", spp)[-1].startswith("Error: ")
