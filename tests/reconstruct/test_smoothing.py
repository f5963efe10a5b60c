"""tv: auto: the weight is one that was tried, the best of them, and found the same way again."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from ddrecon.errors import SceneError
from ddrecon.reconstruct import smoothing
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.smoothing import find_smoothing
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

BALL = Path(__file__).parents[2] / "configs" / "ball.yaml"


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    monkeypatch.setattr(smoothing, "ITERATIONS", 2)
    small = ["volume.resolution=[8, 8, 8]", "optimize.refine_at=[]"]
    small += ["diffusion.transport_rounds=0"]
    return load_scene(BALL, overrides=[*small, "optimize.parameters.density={tv: auto}"])


def runs_of(quality: Callable[[float], float]) -> Callable[[Scene], Any]:
    """Begins runs that are done at once, whose view left out has the `quality` of their weight."""

    class Tried:
        """A run whose picture is off by as much as its weight says."""

        is_done = True

        def __init__(self, scene: Scene):
            assert scene.optimize is not None
            self.scene, self.weight = scene, scene.optimize.parameters["density"].tv

        @property
        def test_targets(self) -> dict[str, Any]:
            weight = self.weight

            class Target:
                image, seen = torch.ones(3, 1, 1), None

                def psnr_of(self, image: torch.Tensor) -> float:
                    assert isinstance(weight, float)
                    return quality(weight)

            return {view.name: Target() for view in self.scene.views}

        def step(self) -> None:
            raise AssertionError("it is done")

        def current_scene(self) -> Scene:
            return self.scene

    return Tried


@pytest.mark.parametrize("best", [3e-4, 4e-2])
def test_the_best_weight_is_taken(scene: Scene, best: float) -> None:
    """Where quality is a parabola over decades, whose top lies between two of them."""
    found = find_smoothing(scene, runs_of(lambda weight: -(math.log10(weight / best) ** 2)))
    assert abs(math.log10(found.weight / best)) < 0.25 and len(found.tried) == 6


def test_pictures_that_do_not_tell_leave_the_usual_weight(scene: Scene) -> None:
    found = find_smoothing(scene, runs_of(lambda weight: 30 + 0.02 * math.log10(weight)))
    assert found.weight == pytest.approx(3e-3, rel=0.1)


def test_a_run_smooths_as_it_found_and_goes_on_so(scene: Scene) -> None:
    run = Reconstruction(scene)
    run.step()
    assert run.smoothing is not None
    assert run.parameters[0].tv == run.smoothing.weight
    assert run.smoothing.view in {view.name for view in scene.views if not view.is_test}
    again = Reconstruction(scene)
    again.restore(run.state())
    assert again.smoothing == run.smoothing and again.parameters[0].tv == run.smoothing.weight
    other = Reconstruction(scene)
    other.step()
    assert other.smoothing == run.smoothing
    assert torch.equal(other.parameters[0].value, run.parameters[0].value)


def test_two_views_are_too_few(scene: Scene) -> None:
    views = [view for view in scene.views if not view.is_test][:2]
    with pytest.raises(SceneError, match=r"density\.tv: auto leaves a training view out") as caught:
        Reconstruction(replace(scene, views=views)).step()
    assert len(caught.value.problems) == 1


def test_auto_is_for_density() -> None:
    with pytest.raises(SceneError, match=r"albedo\.tv: .auto. is for density alone"):
        load_scene(
            BALL,
            overrides=["optimize.parameters={density: {}, albedo: {field: true, tv: auto}}"],
        )
