"""Commands on a device of its own, from reading to reports: no GPU is needed."""

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result
from far_device import FAR

from ddrecon.cli.session import Session

Run = Callable[..., Result]
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("shapes_by_python")]


def test_commands_end_well_there(succeed: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Solves and rounds there are tried by `tests/test_far_device.py`, and by `gradcheck`."""
    monkeypatch.setattr(Session, "start", lambda _: FAR)
    run = "optimize", "scene.yaml", "-o", "run", "-D", "diffusion.model=none", "--iterations"
    succeed(*run, "2")
    succeed(*run, "3", "--resume")
    succeed("uncertainty", "run", "-o", "sure", "--calibrate", "1")
    succeed("render", "run", "-o", "seen")
    succeed("gradcheck", "scene.yaml", "--samples", "2")
    assert Path("run/report.html").is_file() and Path("seen/front.npy").is_file()
