"""How far results can be trusted: `reference`, `gradcheck`, and commands on another device."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from far_device import FAR
from small_scene import contents

from ddrecon.cli.session import Session
from ddrecon.losses import Target

REFERENCE = ["reference", "scene.yaml", "-o", "out", "-q", "--spp", "8"]
NEEDED = "the reference needs Mitsuba 3 (the extra `reference`)"


def pixels(name):
    return np.load(f"out/{name}.npy", allow_pickle=False)


def test_theirs_ours_and_the_difference(succeed):
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


def test_ours_is_what_render_makes(succeed):
    pytest.importorskip("mitsuba", reason=NEEDED)
    succeed(*REFERENCE, "--view", "side")
    assert not list(Path("out").glob("front*"))
    succeed("render", "scene.yaml", "-o", "rendered", "-q")
    np.testing.assert_array_equal(pixels("side.ours"), np.load("rendered/side.npy"))


def test_views_are_targets(succeed):
    pytest.importorskip("mitsuba", reason=NEEDED)
    succeed(*REFERENCE, "--views")
    names = [name.split(".") for name in contents(Path("out"))]
    assert {name[0] for name in names} == {"ddrecon", "front", "side", "reference"}
    assert {len(name) for name in names} == {2}
    targets = ["-D", "views.0.image=out/front.npy", "-D", "views.1.image=out/side.png"]
    succeed("optimize", "scene.yaml", "-o", "run", "-q", "--iterations", "1", *targets)
    succeed("render", "scene.yaml", "-o", "rendered", "-q")


def test_without_mitsuba(refuse, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    told = 'the reference renderer: needs mitsuba: pip install "ddrecon[reference]"'
    assert refuse(3, *REFERENCE) == [told]


SMALL = ["-D", "volume.resolution=[4, 3, 3]"]
SIMPLE = ["-D", "diffusion.model=none", "-D", "lights.1.radiance=0"]
GRADCHECK = ["gradcheck", "scene.yaml", "-q", "--samples", "2"]


def test_the_program_passes(run):
    result = run(*GRADCHECK, *SMALL, "--json", "report.json")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.splitlines()[-2].startswith("| density | pass |")
    report = json.loads(Path("report.json").read_text())
    assert report["passed"] is True
    (check,) = report["checks"]
    assert (check["parameter"], check["passed"], len(check["entries"])) == ("density", True, 3)
    assert check["modes_error"] < 1e-10 and max(entry["error"] for entry in check["entries"]) < 1e-6


def detaching_part(right):
    """The image loss with the right value and nine tenths of its derivative."""
    return lambda target, image: right(target, 0.9 * image + 0.1 * image.detach())


def test_a_wrong_derivative_fails(run, monkeypatch):
    monkeypatch.setattr(Target, "loss_of", detaching_part(Target.loss_of))
    result = run(*GRADCHECK, *SMALL, *SIMPLE, "--json", "report.json")
    assert (result.exit_code, result.stderr) == (1, "")
    assert result.stdout.splitlines()[-2].startswith("| density | FAIL |")
    report = json.loads(Path("report.json").read_text())
    assert report["passed"] is False
    errors = [entry["error"] for entry in report["checks"][0]["entries"]]
    assert errors == pytest.approx([0.1] * len(errors), abs=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("shapes_by_python")
def test_commands_end_well_there(succeed, monkeypatch):
    monkeypatch.setattr(Session, "start", lambda _: FAR)
    text = Path("scene.yaml").read_text()
    text = text.replace("  - {type: ambient, radiance: 0.1}\n", "")
    Path("scene.yaml").write_text(text.replace("transport_rounds: 0", "model: none"))
    succeed("optimize", "scene.yaml", "-o", "run", "--iterations", "1")
    succeed("optimize", "scene.yaml", "-o", "run", "--iterations", "2", "--resume")
    succeed("uncertainty", "run", "-o", "sure", "--calibrate", "1")
    succeed("render", "run", "-o", "seen")
    succeed("gradcheck", "scene.yaml", "--samples", "2")
    assert Path("run/report.html").is_file() and Path("seen/front.npy").is_file()
