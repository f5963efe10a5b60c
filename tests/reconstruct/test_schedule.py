"""When a run ends by itself: at rest, or at the most, and the same when resumed."""

import json
from collections.abc import Callable
from dataclasses import asdict

import pytest
import torch

from ddrecon.reconstruct.levels import stage_of
from ddrecon.reconstruct.schedule import Progress, Schedule, rate_at
from ddrecon.reconstruct.tuning import FALL, MOST_ITERATIONS, PLANNED, WINDOW
from ddrecon.settings import AUTO, OptimizeSettings, ParameterSettings

LossOf = Callable[[int], float]


def schedule_of(
    count: int = 1, iterations: int | str = AUTO, drawn: int = 0, begin_at: float = 0.0
) -> Schedule:
    parameters, refine_at = {"density": ParameterSettings()}, (0.4, 0.8)
    settings = OptimizeSettings(
        parameters, iterations, None, None, drawn, refine_at=refine_at, begin_at=begin_at
    )
    return Schedule(settings, count)


def drive(schedule: Schedule, loss_of: LossOf) -> list[int]:
    """The stages of the iterations until `schedule` is over, for these losses."""
    stages: list[int] = []
    while not schedule.is_over(len(stages)):
        made = len(stages)
        stages.append(schedule.stage(made))
        schedule.note(made, loss_of(made))
    return stages


def test_a_number_of_iterations_is_made_whatever_the_loss() -> None:
    schedule = schedule_of(iterations=50)
    stages = drive(schedule, lambda _: 1.0)
    assert stages == [stage_of(i, 50, (0.4, 0.8)) for i in range(50)]
    rates = [schedule.rate(i, 0.2) for i in range(50)]
    assert rates == [rate_at(i, 50, 10, 0.2) for i in range(50)]
    assert schedule.ending(50)["kind"] == "iterations"


def test_a_run_begun_later_is_the_rest_of_a_whole_one() -> None:
    whole, rest = schedule_of(iterations=60), schedule_of(iterations=60, begin_at=0.7)
    stages = drive(rest, lambda _: 1.0)
    assert stages == drive(whole, lambda _: 1.0)[42:]
    assert [rest.rate(i, 0.2) for i in range(18)] == [whole.rate(i, 0.2) for i in range(42, 60)]


def test_a_loss_that_falls_goes_on_as_planned_and_then_to_the_most() -> None:
    schedule = schedule_of()
    # By a little more in a window than what counts as rest.
    stages = drive(schedule, lambda made: (1 - 1.01 * FALL) ** (made / WINDOW))
    assert len(stages) == MOST_ITERATIONS and schedule.ending(MOST_ITERATIONS)["kind"] == "bound"
    assert stages == [stage_of(i, PLANNED, (0.4, 0.8)) for i in range(MOST_ITERATIONS)]
    assert schedule.rate(MOST_ITERATIONS - 1, 0.0) == pytest.approx(schedule.final_rate)


def test_a_loss_at_rest_ends_a_part_after_two_windows() -> None:
    schedule = schedule_of()
    stages = drive(schedule, lambda made: (1 - 0.99 * FALL) ** (made / WINDOW))
    # The last resolution has two parts, the second at the lowest rates.
    assert stages == [0] * 2 * WINDOW + [1] * 2 * WINDOW + [2] * 4 * WINDOW
    assert schedule.ending(len(stages))["kind"] == "rest"


def test_a_window_tells_no_view_from_another() -> None:
    """Views whose losses differ a hundredfold are drawn in turn, and none comes down."""
    schedule = schedule_of(count=50, drawn=4)
    stages = drive(schedule, lambda made: 100.0 if made % 25 < 8 else 1.0)
    assert schedule.window == 25 and stages == [0] * 50 + [1] * 50 + [2] * 100


def test_a_schedule_goes_on_as_if_it_had_never_stopped() -> None:
    random = torch.rand(MOST_ITERATIONS, generator=torch.Generator().manual_seed(3)).tolist()
    whole, parts, made = schedule_of(), schedule_of(), 0
    while not whole.is_over(made):
        assert not parts.is_over(made) and parts.stage(made) == whole.stage(made)
        loss = 0.97**made + 0.1 * random[made]
        for schedule in (whole, parts):
            schedule.note(made, loss)
        if made % 9 == 0:
            state = json.loads(json.dumps(asdict(parts.progress)))
            parts = schedule_of()
            parts.progress = Progress(**state)
        made += 1
    assert parts.is_over(made) and parts.progress == whole.progress
