"""`ddrecon uncertainty --next-view`: pictures by how far off those taken they are."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

Run = Callable[..., Result]
SCENE = ["-D", "diffusion.model=none", "-D", "lights.1.radiance=0", "--iterations", "4"]
RANK = ["-q", "--calibrate", "1", "--noise", "0.05", "--next-view", "ring"]


@pytest.mark.slow
def test_cameras_are_ranked(folder: Path, succeed: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ddrecon.uncertainty.next_view.CANDIDATES", 4)
    succeed("optimize", "scene.yaml", "-o", "run", "-q", *SCENE)
    sure = "uncertainty", "run", "-o", "sure", *RANK
    succeed(*sure)
    stdout = succeed(*sure, "--resume").stdout
    views = json.loads(Path("sure/uncertainty.json").read_text())["next_views"]
    angles = [view["angle"] for view in views]
    # One candidate is what there is.
    assert angles == sorted(angles, reverse=True) and views[0]["is_tied"]
    assert angles[-1] == pytest.approx(0, abs=0.1) and not views[-1]["is_tied"]
    told = stdout.count("not to be distinguished from the first")
    assert told == sum(view["is_tied"] for view in views[1:])
    assert f"next view: {views[0]['name']} {angles[0]:.0f} degrees from" in stdout
    assert views[0]["name"] in Path("sure/report.html").read_text()
    # Each stands as far from the middle as the camera of the run, and looks another way.
    away = [[row[3] for row in view["matrix"][:3]] for view in views]
    assert [sum(x * x for x in eye) for eye in away] == pytest.approx([2.5**2] * 4, rel=1e-4)
    assert len({(round(x, 4), round(z, 4)) for x, _, z in away}) == 4
