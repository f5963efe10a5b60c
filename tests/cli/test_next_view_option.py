"""`ddrecon uncertainty --next-view`: pictures by how far off those taken they are."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result

Run = Callable[..., Result]
SCENE = ["-D", "diffusion.model=none", "-D", "lights.1.radiance=0", "--iterations", "4"]
RANK = ["-q", "--calibrate", "1", "--noise", "0.05", "--next-view"]


@pytest.mark.slow
def test_cameras_and_lights_are_ranked(
    folder: Path, succeed: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ddrecon.uncertainty.next_view.CANDIDATES", 4)
    succeed("optimize", "scene.yaml", "-o", "run", "-q", *SCENE)
    found = {}
    for kind in ("ring", "lights"):
        sure = "uncertainty", "run", "-o", kind, *RANK, kind
        succeed(*sure)
        stdout = succeed(*sure, "--resume").stdout
        views = json.loads(Path(kind, "uncertainty.json").read_text())["next_views"]
        angles = [view["angle"] for view in views]
        # One candidate is what there is.
        assert angles == sorted(angles, reverse=True) and views[0]["is_tied"]
        assert angles[-1] == pytest.approx(0, abs=0.1) and not views[-1]["is_tied"]
        told = stdout.count("not to be distinguished from the first")
        assert told == sum(view["is_tied"] for view in views[1:])
        assert f"next view: {views[0]['name']} {angles[0]:.0f} degrees from" in stdout
        assert views[0]["name"] in Path(kind, "report.html").read_text()
        found[kind] = {view["name"]: view for view in views}
    # Each stands as far from the middle as the camera of the run, and looks another way.
    away = [[row[3] for row in view["matrix"][:3]] for view in found["ring"].values()]
    assert [sum(x * x for x in eye) for eye in away] == pytest.approx([2.5**2] * 4, rel=1e-4)
    # All travel as far down as the first, which is the scene's.
    ways = [view["light_directions"][0] for view in found["lights"].values()]
    assert {round(way[1] - ways[0][1], 5) for way in ways} == {0}
    given = found["lights"]["light_000"]["light_directions"][0]
    for view in found["lights"].values():
        cosine = math.cos(math.radians(view["angle"]))
        dot = np.dot(view["light_directions"][0], given) / np.dot(given, given)
        assert cosine == pytest.approx(dot, abs=1e-5)
    for places in (away, ways):
        assert len({(round(x, 4), round(z, 4)) for x, _, z in places}) == 4
