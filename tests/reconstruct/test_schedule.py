"""When a run goes on to its next stage, when it ends, and that it does so when resumed."""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import pytest
import torch
from media import box_grid

from ddrecon.light.lights import AmbientLight, DirectionalLight
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.schedule import Progress, Schedule, Stage, find_stages
from ddrecon.reconstruct.tuning import ELASTICITY, MOST_ITERATIONS, REST
from ddrecon.settings import AUTO, ParameterSettings

STAGES = [Stage(0), Stage(1), Stage(2)]


class FakeSearch(SimpleNamespace):
    """A search whose loss of images is `loss`, with a prior, and that can still gain `gain`."""

    def __init__(self, loss, gain, prior=1.0):
        super().__init__(
            gain=gain, moves=1, weight=1.0, objective=SimpleNamespace(loss=loss, prior=prior)
        )

    def reweigh(self, weight):
        self.weight = weight


def drive(schedule, gain, loss=1.0):
    """The levels of the iterations until `schedule` is over, by a search that stays as it is."""
    levels, search = list[int](), FakeSearch(loss, gain)
    while not schedule.is_over(len(levels)):
        levels.append(schedule.stage.level)
        schedule.note(len(levels), search, 0.0)
    return levels


def test_a_stage_ends_at_rest_and_the_last_one_ends_the_run():
    schedule = Schedule(AUTO, STAGES)
    # The prior counts half as much once, and the loss does not fall by that.
    assert drive(schedule, 0.9 * REST) == [0, 1, 2, 2]
    assert schedule.ending(4)["kind"] == "rest"


@pytest.mark.parametrize(("iterations", "most"), [(AUTO, MOST_ITERATIONS), (50, 50), (1, 1)])
def test_a_run_that_never_rests_ends_at_its_bound_at_full_resolution(iterations, most):
    """Later stages have at least half of what is left."""
    schedule = Schedule(iterations, STAGES)
    levels = drive(schedule, 1.1 * REST)
    assert len(levels) == most and levels == sorted(levels)
    assert levels.count(0) <= max(most // 2, 1) and levels.count(1) <= max(most // 4 + 1, 1)
    assert schedule.ending(most)["kind"] == ("bound" if iterations == AUTO else "iterations")


def test_the_prior_is_halved_until_the_loss_is_the_noise():
    """Or hardly falls by that: by less than the power `ELASTICITY` of its weight."""
    for noise, power, halved in ((0.3, 0.5, 4), (0.0, 0.9 * ELASTICITY, 1)):
        schedule, search, made = Schedule(AUTO, STAGES[:1]), FakeSearch(1.0, 0.0), 0
        while not schedule.is_over(made):
            made += 1
            schedule.note(made, search, noise)
            # What the loss falls to with the weight that counts from here.
            search.objective.loss = search.weight**power
        assert search.weight == 2.0**-halved


def test_a_schedule_goes_on_as_if_it_had_never_stopped():
    random = torch.rand(MOST_ITERATIONS, generator=torch.Generator().manual_seed(3)).tolist()
    whole, parts, count = Schedule(AUTO, STAGES), Schedule(AUTO, STAGES), 0
    while not whole.is_over(count):
        assert not parts.is_over(count) and parts.stage == whole.stage
        for schedule in (whole, parts):
            search = FakeSearch(0.97**count + 0.1 * random[count], 40 * REST * random[count])
            schedule.note(count + 1, search, 0.1)
        state = json.loads(json.dumps(asdict(parts.progress)))
        parts = Schedule(AUTO, STAGES)
        parts.progress = Progress(**state)
        count += 1
    assert parts.is_over(count) and parts.progress == whole.progress


@pytest.mark.parametrize(
    ("others", "lights", "waiting"),
    [
        (["density"], [AmbientLight(torch.ones(1))], {"emission", "g"}),
        (["density"], [DirectionalLight(torch.ones(3), torch.ones(1))], {"emission", "g"}),
        (["density"], [], {"g"}),
        ([], [AmbientLight(torch.ones(1))], {"g"}),
    ],
)
def test_numbers_wait_for_empty_fields_and_what_glows_for_what_is_lit(
    ball_scene, others, lights, waiting
):
    """In the dark, or alone, glow is all that pictures can show; light from one side tells all."""
    grid, scene = box_grid((4, 4, 4)), replace(ball_scene, lights=lights)
    empty = torch.zeros(grid.shape)
    values = dict.fromkeys([*others, "emission"], empty) | {"g": torch.tensor(0.1)}
    parameters = [Parameter(n, ParameterSettings(), v, grid) for n, v in values.items()]
    stages = find_stages(3, scene, parameters)
    is_told = any(isinstance(light, DirectionalLight) for light in lights)
    trials = [0] if others and not is_told else []
    assert [stage.level for stage in stages] == [0, 0, *trials, 1, 2]
    assert [at for at, stage in enumerate(stages) if stage.is_trial] == [2] * len(trials)
    assert stages[0].waiting == waiting and not any(stage.waiting for stage in stages[1:])
    for parameter in parameters:
        parameter.start = torch.rand(grid.shape) if parameter.is_field else parameter.start
    # A structure is never coarsened, and numbers are seen by it.
    assert find_stages(3, scene, parameters) == [Stage(2)]


def test_what_glows_beside_a_medium_moves_with_it_once(ball_scene):
    """At the coarsest resolution, after all else there."""
    grid, empty = ball_scene.volume.grid, torch.zeros(ball_scene.volume.grid.shape)
    density, emission = (
        Parameter(name, ParameterSettings(), empty, grid) for name in ("density", "emission")
    )
    emission.glow_in(density)
    stages = find_stages(3, replace(ball_scene, lights=[]), [density, emission])
    assert [stage.level for stage in stages if stage.is_per_depth] == [0]
    assert [stage.level for stage in stages if not stage.is_per_depth][-2:] == [1, 2]
    assert stages[-3].is_per_depth


@pytest.mark.slow
def test_a_run_rests_within_the_noise_that_is_known(coarse_ball):
    run = Reconstruction(coarse_ball, AUTO)
    while not run.is_done:
        run.step()
    ending = run.ending()
    assert ending["kind"] == "rest" and ending["residual"] < 3 * ending["noise"]


def test_what_is_cut_short_has_no_trial():
    stages = [Stage(0), Stage(0, is_trial=True), Stage(1)]
    assert drive(Schedule(8, stages), 1.1 * REST) == [0] * 4 + [1] * 4


@pytest.mark.parametrize(("prior", "levels"), [(0.4, [0, 1, 2]), (0.6, [0, 1, 1, 2, 2])])
def test_noise_is_not_fitted_on_refined_grids_where_the_prior_is_light(prior, levels):
    """A loss of 1 is that of noise; the search itself could gain more."""
    schedule, made = Schedule(6, STAGES), list[int]()
    while not schedule.is_over(len(made)) and len(made) < len(levels):
        made.append(schedule.stage.level)
        gain = 0.0 if len(made) == 1 else 1.0
        schedule.note(len(made), FakeSearch(1.0, gain, prior), 1.0)
    assert made == levels
    assert schedule.ending(len(made))["kind"] == ("noise" if prior < 0.5 else "iterations")


def test_no_stage_ends_before_something_has_moved():
    """Runs of few iterations came to nothing: each stage looked where it began, and was over."""
    schedule, search = Schedule(3, STAGES), FakeSearch(1.0, 1.1 * REST)
    search.moves = 0
    schedule.note(1, search, 0.0)
    assert schedule.progress.stage == 0
    search.moves = 1
    schedule.note(2, search, 0.0)
    assert schedule.progress.stage == 1
