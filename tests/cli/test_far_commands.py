"""Commands on a device of its own, from reading to reports: no GPU is needed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from far_device import FAR

from ddrecon.cli import session
from ddrecon.uncertainty import posterior

Run = Callable[..., Result]


@pytest.mark.slow
def test_commands_end_well_there(succeed: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    own, used = session.Session, []

    def open_there(overrides: Any, device: Any, *others: Any) -> session.Session:
        used.append(own(overrides, FAR, *others))
        return used[-1]

    monkeypatch.setattr(session, "Session", open_there)
    for name in ("MOST", "ROUNDS", "INNER"):
        monkeypatch.setattr(posterior, name, 1)
    succeed("optimize", "scene.yaml", "-o", "run", "--iterations", "2")
    succeed("optimize", "scene.yaml", "-o", "run", "--iterations", "3", "--resume")
    succeed("uncertainty", "run", "-o", "sure", "--samples", "2")
    succeed("render", "run", "-o", "seen")
    succeed("gradcheck", "scene.yaml", "--samples", "2")
    assert {one.device for one in used} == {FAR}
    assert Path("run/report.html").is_file() and Path("seen/front.npy").is_file()
