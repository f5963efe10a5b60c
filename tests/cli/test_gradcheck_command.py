"""`ddrecon gradcheck` passes for the program, and fails where a derivative is wrong."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result
from torch import Tensor

from ddrecon.losses import Target

Run = Callable[..., Result]
SMALL = ["-D", "volume.resolution=[4, 3, 3]"]
SIMPLE = ["-D", "diffusion.model=none", "-D", "lights.1.radiance=0"]
GRADCHECK = ["gradcheck", "scene.yaml", "-q", "--samples", "2"]


def test_the_program_passes(run: Run) -> None:
    result = run(*GRADCHECK, *SMALL, "--json", "report.json")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout.splitlines()[-1].startswith("| density | pass |")
    report = json.loads(Path("report.json").read_text())
    assert report["passed"] is True
    (check,) = report["checks"]
    assert (check["parameter"], check["passed"], len(check["entries"])) == ("density", True, 3)
    assert check["modes_error"] < 1e-10 and max(entry["error"] for entry in check["entries"]) < 1e-6


def detaching_part(right: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """The image loss with the right value and nine tenths of its derivative."""
    return lambda target, image: right(target, 0.9 * image + 0.1 * image.detach())


def test_a_wrong_derivative_fails(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Target, "loss_of", detaching_part(Target.loss_of))
    result = run(*GRADCHECK, *SMALL, *SIMPLE, "--json", "report.json")
    assert (result.exit_code, result.stderr) == (1, "")
    assert result.stdout.splitlines()[-1].startswith("| density | FAIL |")
    report = json.loads(Path("report.json").read_text())
    assert report["passed"] is False
    errors = [entry["error"] for entry in report["checks"][0]["entries"]]
    assert errors == pytest.approx([0.1] * len(errors), abs=1e-3)
