"""The loss that pictures deserve: by their kind, unless the scene says."""

from dataclasses import replace

import pytest

from ddrecon.errors import SceneError
from ddrecon.reconstruct.setup import choose_loss
from ddrecon.scene import Scene


def with_steps(scene: Scene, *steps: float) -> Scene:
    views = [replace(view, step=step) for view, step in zip(scene.views, steps, strict=False)]
    return replace(scene, views=views)


def test_files_of_srgb_are_compared_as_displayed_and_linear_ones_as_they_are(
    ball_scene: Scene,
) -> None:
    assert ball_scene.optimize is not None
    assert choose_loss(ball_scene.optimize, with_steps(ball_scene, 1 / 255, 1 / 65535)) == "display"
    assert choose_loss(ball_scene.optimize, with_steps(ball_scene, 0, 0)) == "l2"


def test_pictures_of_both_kinds_need_a_loss(ball_scene: Scene) -> None:
    mixed = with_steps(ball_scene, 0, 1 / 255)
    assert ball_scene.optimize is not None
    with pytest.raises(SceneError, match="say how to compare them"):
        choose_loss(ball_scene.optimize, mixed)
    assert choose_loss(replace(ball_scene.optimize, loss="photon"), mixed) == "photon"
