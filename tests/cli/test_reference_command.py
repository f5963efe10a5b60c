"""What `ddrecon reference` writes and says."""

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
    result = succeed(*REFERENCE, "--json")
    report = json.loads(Path("out/reference.json").read_text())
    assert json.loads(result.stdout) == report
    files = {file for files in report["files"].values() for file in files}
    assert files | {"ddrecon.manifest", "reference.json"} == set(contents(Path("out")))
    assert report["settings"]["samples_per_pixel"] == 8 and report["settings"]["passes"] >= 4
    assert report["environment"]["mitsuba"] and report["environment"]["ddrecon"]
    for name, view in report["views"].items():
        kinds = ("reference", "ours", "difference")
        theirs, ours, difference = (pixels(f"{name}.{kind}").astype(float) for kind in kinds)
        assert theirs.shape == ours.shape == (6, 8, 3)
        np.testing.assert_allclose(ours - theirs, difference, atol=1e-6)
        square, mean = np.square(ours - theirs).mean(), np.square(theirs).mean()
        assert view["distance"] == pytest.approx(np.sqrt(square / mean), rel=1e-4)
        error = np.sqrt(max(0, view["distance"] ** 2 - view["noise"] ** 2))
        assert view["error"] == pytest.approx(error, abs=1e-9)
        assert view["psnr"] == pytest.approx(10 * np.log10(theirs.max() ** 2 / square), abs=1e-2)
        assert view["brightness"] == pytest.approx(ours.mean() / theirs.mean(), rel=1e-4)


def test_ours_is_what_render_makes(succeed: Run) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    succeed(*REFERENCE, "--view", "side")
    assert not list(Path("out").glob("front*"))
    succeed("render", "scene.yaml", "-o", "rendered", "-q")
    np.testing.assert_array_equal(pixels("side.ours"), np.load("rendered/side.npy"))


def test_views_are_targets(succeed: Run) -> None:
    pytest.importorskip("mitsuba", reason=NEEDED)
    succeed(*REFERENCE, "--views")
    names = [name.split(".") for name in contents(Path("out"))]
    assert {name[0] for name in names} == {"ddrecon", "front", "side", "reference"}
    assert {len(name) for name in names} == {2}
    targets = ["-D", "views.0.image=out/front.npy", "-D", "views.1.image=out/side.png"]
    succeed("optimize", "scene.yaml", "-o", "run", "-q", "--iterations", "1", *targets)
    succeed("render", "scene.yaml", "-o", "rendered", "-q")


def test_without_mitsuba(refuse: Refuse, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    told = 'the reference renderer needs mitsuba: pip install "ddrecon[reference]"'
    assert refuse(3, *REFERENCE) == [told]
