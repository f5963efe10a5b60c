"""The loss that pictures deserve, by their kind; and the units of penalties."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from media import random_values

from ddrecon.errors import FormatError, SceneError
from ddrecon.light.lights import AmbientLight, EnvironmentLight
from ddrecon.reconstruct.frame import Frame
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.setup import Problem, choose_loss, targets_of
from ddrecon.settings import NoiseSettings, ParameterSettings


def test_what_shows_nothing_is_refused_and_what_shows_little_is_not(ball_scene):
    """Masks that leave no pixel, black pictures, and no light at all; one of each is enough."""
    scene, (first, *others) = ball_scene, ball_scene.views
    black = [replace(view, mask=torch.zeros(view.camera.size)) for view in others]
    empty = [replace(view, image=0 * view.image) for view in others]
    dark = [AmbientLight(torch.zeros(1)), EnvironmentLight(torch.ones(1, 2, 3), *torch.zeros(2))]
    backlit = replace(first, background=torch.ones(1, 1, 1))
    sought = replace(scene.optimize, parameters={"lights.1.scale": ParameterSettings()})
    for change, error in (
        ({"views": [black[0], *black]}, FormatError),
        ({"views": empty}, FormatError),
        ({"views": [first, *black, *empty]}, None),
        ({"lights": dark}, SceneError),
        ({"lights": []}, SceneError),
        ({"lights": [*scene.lights, *dark]}, None),
        ({"lights": dark, "views": [backlit, *others]}, None),
        ({"lights": dark, "optimize": sought}, None),
    ):
        with (
            nullcontext()
            if error is None
            else pytest.raises(error, match=r"shows anything|none shines")
        ):
            Reconstruction(replace(scene, **change))


def with_steps(scene, *steps):
    views = [replace(view, step=step) for view, step in zip(scene.views, steps, strict=False)]
    return replace(scene, views=views)


def test_files_of_srgb_are_compared_as_displayed_and_linear_ones_as_they_are(ball_scene):
    assert ball_scene.optimize is not None
    assert choose_loss(ball_scene.optimize, with_steps(ball_scene, 1 / 255, 1 / 65535)) == "display"
    assert choose_loss(ball_scene.optimize, with_steps(ball_scene, 0, 0)) == "l2"


def test_pictures_of_both_kinds_need_a_loss(ball_scene):
    mixed = with_steps(ball_scene, 0, 1 / 255)
    assert ball_scene.optimize is not None
    with pytest.raises(SceneError, match="say how to compare them"):
        choose_loss(ball_scene.optimize, mixed)
    assert choose_loss(replace(ball_scene.optimize, loss="photon"), mixed) == "photon"


def test_photon_counts_errors_in_units_of_the_noise_that_is_given(ball_scene):
    """The mean square error over read^2 + shot times radiance."""
    flat = torch.full_like(ball_scene.views[0].image, 0.5)
    noise = NoiseSettings(read=0.3, shot=0.2)
    settings = replace(ball_scene.optimize, loss="photon", noise=noise)
    views = [replace(ball_scene.views[0], image=flat)]
    problem = Problem.of(replace(ball_scene, views=views, optimize=settings))
    (target,) = targets_of(problem.train, problem.loss, problem.noises).values()
    loss = float(target.loss_of(flat + 0.3))
    assert loss == pytest.approx(0.3**2 / (0.3**2 + 0.2 * 0.5), rel=1e-5)


def test_smoothing_of_what_glows_also_moves_its_density(ball_scene):
    """The prior's derivatives by both are its differences."""
    volume = replace(ball_scene.volume, emission=torch.zeros(3, *ball_scene.volume.grid.shape))
    sought = {name: ParameterSettings() for name in ("density", "emission")}
    settings = replace(ball_scene.optimize, parameters=sought)
    frame = Frame(replace(ball_scene, volume=volume, optimize=settings), None)
    frame.enter(0)
    starts = {p: random_values(*p.value.shape).float() * p.unit for p in frame.parameters}

    def evaluate(moved, step):
        for p, start in starts.items():
            p.value = (start + step * start.flip(-1) * (p is moved)).requires_grad_()
        return frame.evaluate()

    for p, start in starts.items():
        slope = float((evaluate(p, 0.0).prior_gradients[p.name] * start.flip(-1)).sum())
        change = evaluate(p, 2e-3).prior - evaluate(p, -2e-3).prior
        assert change / 4e-3 == pytest.approx(slope, rel=0.01)
