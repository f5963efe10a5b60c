"""Deviations by experiments: what is reconstructed next, and what follows of known errors."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from media import make_camera, make_scene, random_values
from torch import Tensor

from ddrecon.grid import Grid
from ddrecon.picture import render
from ddrecon.pictures.noise import Noise
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import View
from ddrecon.settings import OptimizeSettings, ParameterSettings
from ddrecon.uncertainty.deviations import RATIO, Deviations, Field
from ddrecon.uncertainty.experiments import Uncertainty

SHAPE = (12, 14, 10)
GRID = Grid(SHAPE, (0.0, 0.0, 0.0), (1.2, 1.4, 1.0))


def parameter_of(name: str, value: Tensor) -> Parameter:
    return Parameter(name, ParameterSettings(), value, GRID)


def found_of(values: dict[str, Tensor], information: float = 1e12) -> Uncertainty:
    """What a run has found, `values`, before any experiment."""
    found: Any = Uncertainty.__new__(Uncertainty)
    found.parameters = [parameter_of(name, value) for name, value in values.items()]
    found.values, found.truth = values, dict(values)
    found.information = {n: torch.full_like(v, information) for n, v in values.items()}
    found.run, found.trial = SimpleNamespace(iteration=1), None
    found.seed, found.count, found.errors = 0, 0, []
    return found


def finished_run() -> Reconstruction:
    """One iteration from two pictures, an eighth off, of a medium that scatters many times."""
    eyes = {"one": (0.2, 0.3, 2.5), "two": (2.4, -0.3, 0.5)}
    rounds = {"transport_rounds": 1, "tolerance": 1e-6}
    world = make_scene(1 + random_values(3, 4, 3), sigma_a=(0.1,), sigma_s=(6.0,), **rounds)
    views = [View(name, make_camera(eye, (5, 6))) for name, eye in eyes.items()]
    images = render(replace(world, views=views))
    images = images * (0.75 + 0.5 * random_values(*images.shape))
    shown = [replace(view, image=image) for view, image in zip(views, images, strict=True)]
    sought = OptimizeSettings(parameters={"density": ParameterSettings()}, iterations=1)
    run = Reconstruction(replace(world, views=shown, optimize=sought))
    run.step()
    return run


def test_an_experiment_is_photographed_closer_to_truth_and_errs_as_the_run_does() -> None:
    """By what the run leaves, or by noise that is known; at first the other way around."""
    run = finished_run()
    scene, diffusion = run.current_scene(), run.current_scene().diffusion
    near, far = (
        render(replace(scene, diffusion=replace(diffusion, transport_rounds=rounds)))
        for rounds in (1, 12)
    )
    wrong = float((near - far).abs().mean())
    for noise in (None, Noise(0.08, 0.0)):
        found = Uncertainty(run, 0, noise)
        for found.count, signs in ((0, [-1]), (1, [-1, 1])):
            views = found._begin().problem.train.views
            for view, given, as_run, true in zip(views, scene.views, near, far, strict=True):
                left = given.image - as_run
                left = left if noise is None else left * noise.read / left.square().mean().sqrt()
                errors = [float((view.image - sign * left - true).abs().mean()) for sign in signs]
                assert min(errors) < 0.3 * min(wrong, float(left.abs().mean()))


def reconstruct_by(
    found: Uncertainty, method: Callable[[Tensor], Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Has experiments of `found` end in one step, by this `method` of each of their truths."""

    def begin() -> Any:
        ended = [parameter_of(name, method(truth)) for name, truth in found.truth.items()]
        return SimpleNamespace(parameters=ended, step=lambda: None, is_done=True, iteration=1)

    monkeypatch.setattr(found, "_begin", begin)


def test_the_next_volume_gets_back_what_a_linear_method_loses(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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


def test_a_truth_stays_within_bounds_and_numbers_stay_as_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    value = random_values(*SHAPE) - 0.5
    found = found_of({"density": value.clamp(min=0), "g": torch.tensor(0.3, dtype=torch.float64)})
    reconstruct_by(found, lambda truth: truth + 0.2, monkeypatch)
    found.step()
    torch.testing.assert_close(found.truth["density"], (value.clamp(min=0) - 0.2).clamp(min=0))
    assert float(found.truth["g"]) == 0.3
    numbers = Deviations(found).numbers()
    assert numbers["g"] == {"value": 0.3, "deviation": pytest.approx(RATIO * 3 * 0.2)}
    # The mass is the integral over the box, and errs by all cells together.
    mass, volume = numbers["mass of density"], 1.2 * 1.4 * 1.0
    assert mass["value"] == pytest.approx(volume * float(value.clamp(min=0).mean()))
    assert mass["deviation"] == pytest.approx(RATIO * 3 * 0.2 * volume)


def test_two_thirds_of_errors_are_within_a_deviation_less_what_experiments_lack() -> None:
    """Where they are normal, of a size that is another at every edge than inside."""
    torch.manual_seed(1)
    value = torch.zeros(SHAPE).double()
    value[3:9, 3:11, 2:8] = 1 + random_values(6, 8, 6)
    found = found_of({"density": value})
    size = torch.where(value > 0, 0.1, 0.01)
    found.errors = [{"density": size * torch.randn(SHAPE)} for _ in range(3)]
    field = Field(found, found.parameters[0])
    assert not bool(field.classes["unseen"].any())
    for name in ("edge", "inside"):
        where = field.classes[name] & field.is_smoke
        errors = torch.stack([error[where] for error in field.errors])
        share = float((errors.abs() < field.deviation[where] / RATIO).double().mean())
        assert share == pytest.approx(0.68, abs=0.01)
    described = field.describe()["classes"]
    assert sum(each["share"] for each in described.values()) == pytest.approx(1)
    for each in described.values():
        assert len(each["factors"]) == 3
        assert each["factors"] == pytest.approx([each["factor"]] * 3, rel=0.3)
    # By the other experiments alone it is nearly as often so.
    assert described["inside"]["within_1"] == pytest.approx(0.86, abs=0.05)
    assert described["inside"]["within_2"] > 0.98


def test_without_experiments_it_is_what_noise_leaves_of_what_a_cell_may_be() -> None:
    """1 / (1 / power + information of the 27 around), by Gauss; and numbers are not told of."""
    value = 2 * torch.ones(SHAPE).double()
    found = found_of(
        {"density": value, "g": torch.tensor(0.3, dtype=torch.float64)}, information=0.75 / 27
    )
    (field,) = Deviations(found).fields.values()
    torch.testing.assert_close(field.deviation.square(), value**0)
    torch.testing.assert_close(field.explained, 0.75 * value**0)
    assert Deviations(found).numbers()["g"]["deviation"] is None


def test_where_pictures_tell_nothing_a_cell_may_be_anything() -> None:
    """However small the errors of experiments are there."""
    value = 1 + random_values(*SHAPE)
    found = found_of({"density": value}, information=0.0)
    found.errors = [{"density": 1e-3 * random_values(*SHAPE)} for _ in range(2)]
    field = Field(found, found.parameters[0])
    assert bool(field.classes["unseen"].all()) and not bool(field.explained.any())
    power = float(value.square().mean())
    torch.testing.assert_close(field.deviation.square(), torch.full(SHAPE, power).double())
    # But where nothing may be, nothing is: there, experiments have no errors.
    support = torch.arange(SHAPE[0])[:, None, None].expand(SHAPE) > 5
    found.parameters[0].support = support.double()
    found.errors = [{"density": support * error["density"]} for error in found.errors]
    field = Field(found, found.parameters[0])
    torch.testing.assert_close(field.classes["unseen"], support)
    assert float(field.deviation[:5].max()) < 1e-6 * power < power / 2 < field.deviation[6:].min()


def test_samples_deviate_as_they_should_and_are_the_same_again() -> None:
    value = 1 + random_values(*SHAPE)
    found = found_of({"density": value})
    found.curvature = SimpleNamespace(join=lambda parts: parts["density"].flatten())
    torch.manual_seed(2)
    found.errors = [{"density": (1 + value) * torch.randn(SHAPE)} for _ in range(2)]
    deviations = Deviations(found)
    field = deviations.fields["density"]
    samples = torch.stack([deviations.draw(number) for number in range(400)])
    ratio = samples.square().mean(0).view(SHAPE) / field.deviation.square()
    assert float(ratio.mean()) == pytest.approx(1, abs=0.05)
    torch.testing.assert_close(deviations.draw(7), samples[7])
