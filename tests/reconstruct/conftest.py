"""The ball scene, small enough to reconstruct in a test; without transport rounds."""

from pathlib import Path

import pytest

from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene_file.build import load_scene

BALL = Path(__file__).parents[2] / "configs" / "ball.yaml"


@pytest.fixture
def ball_scene():
    return load_scene(BALL, overrides=["optimize.iterations=8", "diffusion.transport_rounds=0"])


@pytest.fixture
def coarse_ball(ball_scene):
    """The same in cells and pixels twice as wide."""
    return scene_at_level(ball_scene, 2)
