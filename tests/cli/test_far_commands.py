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
    monkeypatch.setattr(Session, "start", lambda _: FAR)
    text = Path("scene.yaml").read_text()
    Path("scene.yaml").write_text(text.replace("  - {type: ambient, radiance: 0.1}\n", ""))
    succeed("optimize", "scene.yaml", "-o", "run", "--iterations", "2")
    succeed("optimize", "scene.yaml", "-o", "run", "--iterations", "3", "--resume")
    succeed("uncertainty", "run", "-o", "sure", "--calibrate", "1")
    succeed("render", "run", "-o", "seen")
    succeed("gradcheck", "scene.yaml", "--samples", "2")
    assert Path("run/report.html").is_file() and Path("seen/front.npy").is_file()
