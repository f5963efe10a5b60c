"""`ddrecon uncertainty --next-view`: what it ranks, also where it goes on after a stop."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

Run = Callable[..., Result]
SCENE = ["-D", "diffusion.model=none", "-D", "lights.1.radiance=0", "--iterations", "4"]
RANK = ["-q", "--tolerance", "0.9", "--noise", "0.05", "--next-view", "ring"]
COUNT = 4
"""Pictures that are ranked here."""


@pytest.fixture
def finished(folder: Path, succeed: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run of density from one picture."""
    monkeypatch.setattr("ddrecon.uncertainty.next_view.CANDIDATES", COUNT)
    succeed("optimize", "scene.yaml", "-o", "run", "-q", *SCENE)


def ranked(path: str) -> list[dict[str, Any]]:
    return json.loads(Path(path, "uncertainty.json").read_text())["next_views"]


def test_cameras_around_the_volume_are_ranked(finished: None, succeed: Run, run: Run) -> None:
    result = succeed("uncertainty", "run", "-o", "whole", "--samples", "6", *RANK)
    views = ranked("whole")
    gains = [view["gain"] for view in views]
    assert len({view["name"] for view in views}) == COUNT
    assert gains == sorted(gains, reverse=True) and 0 <= gains[-1] < gains[0] <= 1
    assert f"next view: {views[0]['name']}, " in result.stdout
    assert views[0]["name"] in Path("whole/report.html").read_text()
    # Each stands as far from the middle as the camera of the run.
    for view in views:
        assert sum(row[3] ** 2 for row in view["matrix"][:3]) == pytest.approx(2.5**2, rel=1e-4)
    succeed("uncertainty", "run", "-o", "parts", "--samples", "5", *RANK)
    succeed("uncertainty", "run", "-o", "parts", "--samples", "6", "--resume", *RANK)
    assert ranked("parts") == views
    few = run("uncertainty", "run", "-o", "few", "--samples", "4", *RANK)
    assert few.exit_code == 2 and "--next-view takes at least 5 samples" in few.stderr


def test_lights_around_the_volume_are_ranked(finished: None, succeed: Run) -> None:
    lit = [*RANK[:-1], "lights"]
    succeed("uncertainty", "run", "-o", "lit", "--samples", "5", *lit)
    views = {view["name"]: view for view in ranked("lit")}
    assert len(views) == COUNT and all(0 <= view["gain"] <= 1 for view in views.values())
    # All travel as far down as the first, which is the scene's, and none twice the same way.
    ways = [view["light_directions"][0] for _, view in sorted(views.items())]
    assert {round(way[1] - ways[0][1], 5) for way in ways} == {0}
    assert len({(round(way[0], 4), round(way[2], 4)) for way in ways}) == COUNT
    assert "light_000" in Path("lit/report.html").read_text()
