"""The ball scene, small enough to reconstruct in a test; without transport rounds."""

from pathlib import Path

import pytest

from ddrecon.scene_file.build import load_scene

BALL = Path(__file__).parents[2] / "configs" / "ball.yaml"


@pytest.fixture
def ball_scene():
    return load_scene(BALL, overrides=["optimize.iterations=8", "diffusion.transport_rounds=0"])
