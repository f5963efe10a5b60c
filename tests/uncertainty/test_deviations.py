"""Deviations by experiments: what is reconstructed next, and what follows of known errors."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from media import make_camera, make_scene, random_values

from ddrecon.grid import Grid
from ddrecon.picture import render
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import View
from ddrecon.settings import NoiseSettings, OptimizeSettings, ParameterSettings
from ddrecon.uncertainty import RATIO, Field, Uncertainty

SHAPE = (12, 14, 10)
GRID = Grid(SHAPE, (0.0, 0.0, 0.0), (1.2, 1.4, 1.0))


def parameter_of(name, value):
    return Parameter(name, ParameterSettings(), value, GRID)


def found_of(values):
    """What a run has found, `values`, before any experiment."""
    found: Any = Uncertainty.__new__(Uncertainty)
    found.parameters = [parameter_of(name, value) for name, value in values.items()]
    found.values, found.truth = values, dict(values)
    found.run, found.trial = SimpleNamespace(iteration=1), None
    found.seed, found.errors, found.seconds = 0, [], 0.0
    return found


def finished_run(noise=None):
    """One iteration from two pictures, an eighth off, of a medium that scatters many times."""
    eyes = {"one": (0.2, 0.3, 2.5), "two": (2.4, -0.3, 0.5)}
    rounds = {"transport_rounds": 1, "tolerance": 1e-6}
    world = make_scene(1 + random_values(3, 4, 3), sigma_a=(0.1,), sigma_s=(6.0,), **rounds)
    views = [View(name, make_camera(eye, (5, 6))) for name, eye in eyes.items()]
    images = render(replace(world, views=views))
    images = images * (0.75 + 0.5 * random_values(*images.shape))
    shown = [replace(view, image=image) for view, image in zip(views, images, strict=True)]
    known = {"density": ParameterSettings()}
    sought = OptimizeSettings(known, iterations=1, noise=noise)
    run = Reconstruction(replace(world, views=shown, optimize=sought))
    run.step()
    return run


def test_an_experiment_is_photographed_closer_to_truth_and_errs_as_the_run_does():
    """By what the run leaves, or by noise that is known; at first the other way around."""
    scene = finished_run().current_scene()
    diffusion = scene.diffusion
    near, far = (
        render(replace(scene, diffusion=replace(diffusion, transport_rounds=rounds)))
        for rounds in (1, 12)
    )
    wrong = float((near - far).abs().mean())
    for noise in (None, NoiseSettings(read=0.08)):
        found = Uncertainty(finished_run(noise), 0)
        for found.errors, signs in (([], [-1]), ([{}], [-1, 1])):
            views = found._begin().problem.train.views
            for view, given, as_run, true in zip(views, scene.views, near, far, strict=True):
                left = given.image - as_run
                left = left if noise is None else left * noise.read / left.square().mean().sqrt()
                errors = [float((view.image - sign * left - true).abs().mean()) for sign in signs]
                assert min(errors) < 0.3 * min(wrong, float(left.abs().mean()))


def reconstruct_by(found, method, monkeypatch):
    """Has experiments of `found` end in one step, by this `method` of each of their truths."""

    def begin():
        ended = [parameter_of(name, method(truth)) for name, truth in found.truth.items()]
        return SimpleNamespace(parameters=ended, step=lambda: None, is_done=True, iteration=1)

    monkeypatch.setattr(found, "_begin", begin)


def test_the_next_volume_gets_back_what_a_linear_method_loses(monkeypatch):
    """A method that keeps a part s of everything: truths are found (1 - (1 - s)^k) / s of all."""
    value, part = 1 + random_values(*SHAPE), 0.4
    found = found_of({"density": value})
    reconstruct_by(found, lambda truth: part * truth, monkeypatch)
    for count in (1, 2, 3):
        found.step()
        truth = value * (1 - (1 - part) ** count) / part
        torch.testing.assert_close(found.errors[-1]["density"], (part - 1) * truth)
        # What such a method would have made of what is true, it makes of the truth of the last.
        truth = value * (1 - (1 - part) ** (count + 1)) / part
        torch.testing.assert_close(found.truth["density"], truth)


def test_a_truth_stays_within_bounds_and_numbers_stay_as_found(monkeypatch):
    value = random_values(*SHAPE) - 0.5
    found = found_of({"density": value.clamp(min=0), "g": torch.tensor(0.3, dtype=torch.float64)})
    reconstruct_by(found, lambda truth: truth + 0.2, monkeypatch)
    found.step()
    torch.testing.assert_close(found.truth["density"], (value.clamp(min=0) - 0.2).clamp(min=0))
    assert float(found.truth["g"]) == 0.3
    numbers = found.numbers()
    assert numbers["g"] == {"value": 0.3, "deviation": pytest.approx(RATIO * 3 * 0.2)}
    # The mass is the integral over the box, and errs by all cells together.
    mass, volume = numbers["mass of density"], 1.2 * 1.4 * 1.0
    assert mass["value"] == pytest.approx(volume * float(value.clamp(min=0).mean()))
    assert mass["deviation"] == pytest.approx(RATIO * 3 * 0.2 * volume)


def test_a_deviation_is_the_root_mean_square_of_the_errors_around_less_what_experiments_lack():
    """So two thirds of normal errors are within it, by whichever experiments."""
    torch.manual_seed(1)
    value = torch.zeros(SHAPE).double()
    value[3:9, 3:11, 2:8] = 1 + random_values(6, 8, 6)
    found = found_of({"density": value})
    size = 0.1 + 0.02 * torch.arange(SHAPE[2])
    found.errors = [{"density": size * torch.randn(SHAPE)} for _ in range(3)]
    field = Field(found, found.parameters[0])
    z, y, x = 5, 6, 4
    around = torch.stack(
        [e["density"][z - 1 : z + 2, y - 1 : y + 2, x - 1 : x + 2] for e in found.errors]
    )
    assert float(field.deviation[z, y, x]) == pytest.approx(
        RATIO * float(around.square().mean()) ** 0.5
    )
    smoke = value > 0
    errors = torch.stack([error[smoke] for error in field.errors])
    share = float((errors.abs() < field.deviation[smoke] / RATIO).double().mean())
    assert share == pytest.approx(0.68, abs=0.03)
    # Whether experiments hold is told by others of them, and not where there are none.
    described = field.describe()
    assert described["within_1"] == pytest.approx(math.erf(RATIO / 2**0.5), abs=0.03)
    assert described["within_2"] > 0.98
    assert described["deviation"] == pytest.approx(
        RATIO * float(size.square()[2:8].mean()) ** 0.5, rel=0.1
    )
    found.errors = [{"density": 0 * value}, *found.errors[:1]]
    assert Field(found, found.parameters[0]).describe()["within_2"] == pytest.approx(0.5, abs=0.05)
    found.errors = found.errors[1:]
    assert Field(found, found.parameters[0]).describe()["within_1"] is None
