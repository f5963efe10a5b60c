"""When a run ends by itself: at the noise, at rest, or at the most, and the same when resumed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from ddrecon.pictures.noise import Noise
from ddrecon.reconstruct.levels import scene_at_level, stage_of
from ddrecon.reconstruct.log import Result
from ddrecon.reconstruct.loop import optimize
from ddrecon.reconstruct.schedule import Progress, Schedule, rate_at
from ddrecon.reconstruct.tuning import FALL, FINAL_RATE, MOST, PLANNED, WINDOW
from ddrecon.renderer import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import AUTO, NoiseSettings, OptimizeSettings, ParameterSettings

BALL = Path(__file__).parents[2] / "configs" / "ball.yaml"
ONE = {"front": 1.0}
LossOf = Callable[[int], float]


def schedule_of(weights: dict[str, float] = ONE, iterations: int | str = AUTO) -> Schedule:
    parameters = {"density": ParameterSettings()}
    settings = OptimizeSettings(parameters, iterations, refine_at=(0.4, 0.8))
    return Schedule(settings, weights)


def drive(schedule: Schedule, loss_of: LossOf, chi_square_of: LossOf | None = None) -> list[int]:
    """The stages of the iterations until `schedule` is over, for these losses of one view."""
    stages: list[int] = []
    while not schedule.is_over(len(stages)):
        made = len(stages)
        stages.append(schedule.stage(made))
        known = {} if chi_square_of is None else {"front": chi_square_of(made)}
        schedule.note(made, {"front": loss_of(made)}, known, 0.0)
    return stages


def test_a_number_of_iterations_is_made_whatever_the_loss() -> None:
    schedule = schedule_of(iterations=50)
    stages = drive(schedule, lambda _: 1.0, lambda _: 0.1)
    assert stages == [stage_of(i, 50, (0.4, 0.8)) for i in range(50)]
    rates = [schedule.rate(i, 0.2) for i in range(50)]
    assert rates == [rate_at(i, 50, 10) for i in range(50)]
    assert schedule.ending(50)["kind"] == "iterations"


def test_a_loss_that_falls_goes_on_as_planned_and_then_to_the_most() -> None:
    schedule = schedule_of()
    # By a little more in a window than what counts as rest.
    stages = drive(schedule, lambda made: (1 - 1.01 * FALL) ** (made / WINDOW))
    assert len(stages) == MOST and schedule.ending(MOST)["kind"] == "bound"
    assert stages == [stage_of(i, PLANNED, (0.4, 0.8)) for i in range(MOST)]
    assert schedule.rate(MOST - 1, 0.0) == pytest.approx(FINAL_RATE)


def test_a_loss_at_rest_ends_a_part_after_two_windows() -> None:
    schedule = schedule_of()
    stages = drive(schedule, lambda made: (1 - 0.99 * FALL) ** (made / WINDOW))
    # The last resolution has two parts, the second at the lowest rates.
    assert stages == [0] * 2 * WINDOW + [1] * 2 * WINDOW + [2] * 4 * WINDOW
    assert schedule.ending(len(stages))["kind"] == "rest"


def test_at_the_noise_a_coarse_grid_is_refined_and_the_finest_ends() -> None:
    schedule = schedule_of()
    stages = drive(schedule, lambda made: 0.5**made, lambda made: 1.01 if made % 7 else 1.0)
    assert stages == [0] + [1] * 7 + [2] * 7
    assert schedule.ending(len(stages))["kind"] == "noise"


def test_noise_is_that_of_all_views() -> None:
    """Pictures seen in turn: one at its noise says nothing of those that are not."""
    schedule, made = schedule_of({"a": 1.0, "b": 1.0, "c": 1.0}), 0
    while not schedule.is_over(made) and made < 60:
        name = "abc"[made % 3]
        schedule.note(made, {name: 0.5**made}, {name: 0.2 if name == "a" else 1.5}, 0.0)
        made += 1
    assert made == 60 and schedule.chi_square == pytest.approx(3.2 / 3)


def test_a_window_sees_every_view_twice() -> None:
    weights = {f"view_{i}": 1.0 for i in range(100)}
    schedule, made = schedule_of(weights), 0
    # Each view's loss falls by half each time that it is seen, three of them in an iteration.
    while not schedule.is_over(made) and made < 150:
        seen = [(3 * made + i) for i in range(3)]
        schedule.note(made, {f"view_{i % 100}": 0.5 ** (i // 100) for i in seen}, {}, 0.0)
        made += 1
    assert made == 150 and schedule.progress.skipped == 0


def test_a_schedule_goes_on_as_if_it_had_never_stopped() -> None:
    random = torch.rand(MOST, generator=torch.Generator().manual_seed(3)).tolist()
    whole, parts, made = schedule_of(), schedule_of(), 0
    while not whole.is_over(made):
        assert not parts.is_over(made) and parts.stage(made) == whole.stage(made)
        loss = 0.97**made + 0.1 * random[made]
        for schedule in (whole, parts):
            schedule.note(made, {"front": loss}, {}, 0.0)
        if made % 9 == 0:
            state = json.loads(json.dumps(asdict(parts.progress)))
            parts = schedule_of()
            parts.progress = Progress(**state)
        made += 1
    assert parts.is_over(made) and parts.progress == whole.progress


NOISE = Noise(0.01, 1e-3)


@pytest.fixture(scope="module")
def noisy_scene() -> Scene:
    """A ball on 8^3 cells, from three pictures of our own with noise that the scene tells."""
    once = ["diffusion.model=none", "volume.g=0", "lights.1.radiance=0"]  # light scattered once
    small = scene_at_level(load_scene(BALL, overrides=once), 2)
    z, y, x = torch.meshgrid(*[torch.linspace(-1, 1, 8)] * 3, indexing="ij")
    density = (0.8 - x**2 - y**2 - z**2).clamp(min=0)
    small = replace(small, views=[*small.views[:6:2], small.views[-1]])
    images = render(replace(small, volume=replace(small.volume, density=density)))
    generator = torch.Generator().manual_seed(5)
    views = [
        replace(view, image=image + NOISE.deviation(image) * random)
        for view, image in zip(small.views, images, strict=True)
        for random in [torch.randn(image.shape, generator=generator)]
    ]
    settings = OptimizeSettings(
        {"density": ParameterSettings(tv=1e-4)},
        iterations=AUTO,
        refine_at=(),
        noise=NoiseSettings(NOISE.read, NOISE.shot),
    )
    return replace(small, views=views, optimize=settings, starts={"density": torch.zeros(8, 8, 8)})


@pytest.fixture(scope="module")
def ended(noisy_scene: Scene) -> Result:
    """Its run until it ends by itself."""
    return optimize(noisy_scene)


def test_a_run_ends_at_the_noise_and_not_before(noisy_scene: Scene, ended: Result) -> None:
    *before, last = ended.rows
    assert 10 < last.iteration < 100 and last.chi_square <= 1 < min(r.chi_square for r in before)
    # By hand, of the volume that came out.
    pictures = render(ended.scene)
    pairs = [pair for pair in zip(pictures, noisy_scene.views, strict=True) if not pair[1].is_test]
    found = [((i - v.image) / NOISE.deviation(i)).square().mean() for i, v in pairs]
    assert float(torch.stack(found).mean()) == pytest.approx(1, abs=0.1)
    assert last.test_psnr is not None
