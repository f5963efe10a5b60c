"""The loop gets closer, stays within bounds, stops cleanly, and goes on as if never stopped."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from media import random_values

from ddrecon import load_scene
from ddrecon.errors import DivergenceError, FormatError, SceneError, SolveError
from ddrecon.io.volumes.table import read_field
from ddrecon.reconstruct import loop, tuning
from ddrecon.reconstruct.frame import Frame
from ddrecon.reconstruct.gradients import Differentiated
from ddrecon.reconstruct.loop import Reconstruction, optimize
from ddrecon.reconstruct.objective import Comparison
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.run.job import FORMAT, load_checkpoint
from ddrecon.settings import ParameterSettings

TRUTH = Path(__file__).parents[2] / "data" / "ball" / "density.npz"


def error_of(density):
    truth = torch.as_tensor(read_field(TRUTH, "density").values)
    return float((density - truth).abs().sum() / truth.sum())


@pytest.mark.slow
def test_an_empty_volume_comes_closer_to_the_truth(ball_scene):
    result = optimize(ball_scene, iterations=12)
    losses = [row.loss for row in result.rows]
    assert losses[-1] < 0.25 * losses[0]
    assert error_of(result.scene.volume.density) < 0.9 * error_of(ball_scene.starts["density"])
    assert result.scene.volume.density.shape == ball_scene.volume.density.shape
    assert result.rows[-1].test_psnr is not None


def test_the_scene_itself_is_left_alone(coarse_ball):
    before = coarse_ball.volume.density.clone()
    optimize(coarse_ball, iterations=2)
    assert torch.equal(coarse_ball.volume.density, before)
    assert not coarse_ball.volume.density.requires_grad


def test_test_views_do_not_influence_the_result(coarse_ball):
    views = [replace(view, image=view.image * (not view.is_test)) for view in coarse_ball.views]
    spoiled = replace(coarse_ball, views=views)
    volumes = [optimize(scene, iterations=3).scene.volume for scene in (coarse_ball, spoiled)]
    assert torch.equal(volumes[0].density, volumes[1].density)


def test_a_view_of_weight_2_counts_as_two(coarse_ball):
    first, second = coarse_ball.views[:2]
    second = replace(second, image=first.image.flip(2))  # as bright, which is the unit of losses

    def evaluate(*views):
        run = Reconstruction(replace(coarse_ball, views=[*views]), 1)
        evaluation = run.frames[0].evaluate()
        return evaluation.loss, evaluation.gradients["density"]

    heavy = evaluate(replace(first, weight=6.0), replace(second, weight=3.0))
    twice, once = evaluate(first, replace(first, name="again"), second), evaluate(first, second)
    assert heavy[0] == pytest.approx(twice[0], rel=1e-5)
    size = float(heavy[1].abs().max())
    torch.testing.assert_close(heavy[1], twice[1], rtol=0, atol=1e-4 * size)
    assert not torch.allclose(heavy[1], once[1], rtol=0, atol=1e-2 * size)


def test_a_checkpoint_of_another_format_is_refused(tmp_path):
    torch.save({"format": 1, "scene": {}, "state": {}}, tmp_path / "last.pt")
    with pytest.raises(FormatError, match=f"of format 1; this version reads {FORMAT}"):
        load_checkpoint(tmp_path, {})


@pytest.mark.slow
@pytest.mark.parametrize("flaw", ["loss of view", "derivative of the loss"])
def test_divergence_keeps_the_last_good_state(coarse_ball, flaw, monkeypatch):
    """Where no candidate, however near, can be looked at."""
    run, again = Reconstruction(coarse_ball), Reconstruction(coarse_ball)
    run.step()
    run.step()
    good = run.parameters[0].value.detach().clone()
    with monkeypatch.context() as patch:
        if flaw == "loss of view":
            patch.setattr(Comparison, "loss_of", lambda *_: torch.tensor(math.nan))
        else:
            gradients = {"density": torch.full_like(good, math.nan)}
            flawed = Differentiated([], torch.tensor(1.0), gradients)
            patch.setattr(Frame, "_differentiate", lambda *_: flawed)
        with pytest.raises(DivergenceError, match=f"{flaw} .* is not finite"):
            run.step()
    assert torch.equal(run.parameters[0].value, good) and run.iteration == 2
    # It goes on as if nothing had been.
    for _ in range(3):
        again.step()
    run.step()
    assert torch.equal(run.parameters[0].value, again.parameters[0].value)


def test_light_that_cannot_be_solved_for_shortens_a_step(coarse_ball, monkeypatch):
    run, failed = Reconstruction(coarse_ball), list[str]()
    run.step()
    candidate, evaluate = run.search.candidate, Frame.evaluate

    def fail_once(frame):
        if not failed:
            failed.append("once")
            raise SolveError("no light", 9, 1.0, "")
        return evaluate(frame)

    monkeypatch.setattr(Frame, "evaluate", fail_once)
    row = run.step()
    assert row.iteration == 2 and failed
    torch.testing.assert_close(run.parameters[0].value.detach().flatten(), candidate / 2)


def test_a_candidate_that_is_refused_is_logged_and_not_kept(coarse_ball):
    """Its row is of the volume that stays, as rows of others are."""
    run = Reconstruction(coarse_ball)
    row, before = run.step(), run.parameters[0].value.detach().clone()
    # A step so long that all is fog.
    run.search._set_out(1e3 * run.search.step)
    refused = run.step()
    assert refused.iteration == run.total.iteration == 2
    assert torch.equal(run.parameters[0].value, before)
    for known in (refused, run.total):
        assert (known.loss, known.psnr) == (row.loss, row.psnr)
    after = run.step()
    assert after.psnr == pytest.approx(run.frames[0].evaluate().psnr, abs=0.01)


def test_a_scene_without_training_images_is_refused(coarse_ball):
    with pytest.raises(SceneError, match="nothing to reconstruct from"):
        tests = [view for view in coarse_ball.views if view.is_test]
        Reconstruction(replace(coarse_ball, views=tests))
    with pytest.raises(SceneError, match="missing section"):
        Reconstruction(replace(coarse_ball, optimize=None))


@pytest.mark.parametrize("fewest", [8, 4, 2])
def test_a_line_through_two_resolutions(coarse_ball, monkeypatch, fewest):
    """By a clock that counts 0.25 s and a millisecond a cell; twice that the first time."""
    monkeypatch.setattr(tuning, "FEWEST_CELLS", fewest)
    clock, known, evaluate = [0.0], set[int](), Frame.evaluate

    def evaluate_slowly(frame):
        cells = frame.level.train.volume.grid.cells
        clock[0] += (0.25 + cells / 1000) * (1 if cells in known else 2)
        known.add(cells)
        return evaluate(frame)

    monkeypatch.setattr(Frame, "evaluate", evaluate_slowly)
    monkeypatch.setattr(loop, "perf_counter", lambda: clock[0])
    cells = coarse_ball.volume.grid.cells
    assert loop.time_iteration(coarse_ball) == pytest.approx(0.25 + cells / 1000)
    assert len(known) == (1 if fewest == 8 else 2)


NUMBERS = ["views.*.exposure", "lights.0.irradiance"]


@pytest.fixture
def still():
    """The ball, with numbers to find beside its density, in float64; cameras need more pictures."""
    sought = [f"optimize.parameters.{name}={{}}" for name in NUMBERS]
    overrides = ["optimize.iterations=4", "diffusion.transport_rounds=0", *sought]
    scene = load_scene("configs/ball.yaml", overrides=overrides, dtype=torch.float64)
    return scene_at_level(scene, 2)


def values(run):
    return {p.name: p.value.detach() for p in run.parameters}


@pytest.mark.slow
def test_neither_seed_nor_order_of_views_nor_brightness_matters(still):
    """The seed to the bit; the others to rounding: light 16 times as bright is as well shown."""
    sun, sky = still.lights
    lights = [
        replace(sun, irradiance=16 * sun.irradiance),
        replace(sky, radiance=16 * sky.radiance),
    ]
    bright = [replace(view, image=16 * view.image) for view in still.views]
    torch.manual_seed(3)
    known = optimize(still, 3)
    torch.manual_seed(4)
    again = optimize(still, 3)
    assert [row.loss for row in again.rows] == [row.loss for row in known.rows]
    assert torch.equal(again.scene.volume.density, known.scene.volume.density)
    starts = {name: 16 * start for name, start in still.starts.items() if "irradiance" in name}
    for change in (
        {"views": still.views[::-1]},
        {"views": bright, "lights": lights, "starts": still.starts | starts},
    ):
        other = optimize(replace(still, **change), 3).scene.volume.density
        torch.testing.assert_close(other, known.scene.volume.density, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_copies_of_a_scene_find_what_it_finds_alone(still):
    single, together = Reconstruction(still), Reconstruction(still, others=[still])
    while not single.is_done:
        row, rows = single.step(), together.advance()
        assert [other.loss for other in rows] == pytest.approx([row.loss] * 2, rel=1e-6)
    assert together.is_done
    for run in together.frames:
        torch.testing.assert_close(values(run), values(single), rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_volumes_differ_and_numbers_do_not(still):
    other = replace(still, views=[replace(view, image=0.5 * view.image) for view in still.views])
    together = Reconstruction(still, others=[other])
    together.advance()
    state = together.state()
    rows = together.advance()
    one, two = map(values, together.frames)
    for name in one:
        assert torch.equal(one[name], two[name]) == (name != "density")
    # It goes on from its state to the same bits.
    again = Reconstruction(still, others=[other])
    again.restore(state)
    assert [row.loss for row in again.advance()] == [row.loss for row in rows]
    for run, resumed in zip(together.frames, again.frames, strict=True):
        torch.testing.assert_close(values(resumed), values(run), rtol=0, atol=0)


def test_the_search_sees_the_derivative_of_what_it_moves(ball_scene, monkeypatch):
    """Of density and of what glows for each depth of it, in the stage that moves these."""
    monkeypatch.setattr(tuning, "GRADIENT_ERROR", 1e-6)
    shape = ball_scene.volume.grid.shape
    sought = {name: ParameterSettings() for name in ("density", "emission")}
    scene = replace(
        ball_scene,
        volume=replace(ball_scene.volume, emission=torch.zeros(1, *shape)),
        diffusion=replace(ball_scene.diffusion, tolerance=1e-6),
        optimize=replace(ball_scene.optimize, parameters=sought),
    )
    run = Reconstruction(scene)
    (run.schedule.progress.stage,) = (
        at for at, stage in enumerate(run.schedule.stages) if stage.is_per_depth
    )
    for p in run.parameters:
        p.value = 0.3 * p.unit * random_values(*p.value.shape).float()
    run._enter_stage()
    values = run.search.values
    move = 0.3 * values * random_values(*values.shape, seed=1).float()

    def evaluate(step):
        run.search.candidate = values + step * move
        return run._add_up(run._evaluate_candidate())

    ends, middle = [evaluate(step) for step in (-0.02, 0.02)], evaluate(0.0)
    for change, slope in (
        (ends[1].loss - ends[0].loss, middle.gradient),
        (ends[1].prior - ends[0].prior, middle.prior_gradient),
    ):
        assert change / 0.04 == pytest.approx(float(slope @ move), rel=0.05)
