"""A recorded iteration is the plain one, whatever the values are by then."""

import copy
from dataclasses import replace

import pytest
import torch
from media import make_scene, random_values
from scenes import three_views
from tape import record

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import LOG, use_engine
from ddrecon.losses import Target
from ddrecon.reconstruct.gradients import Recording, Replays, differentiate
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.objective import Comparison
from ddrecon.variables.values import value_of

NAMES = "density", "albedo", "lights.0.irradiance"


@pytest.fixture(params=["torch", "warp"])
def scene(request):
    use_engine(request.param)
    settings = {"ambient": (0.2, 0.3, 0.4), "transport_rounds": 1, "tolerance": 1e-12}
    scene = three_views(make_scene(random_values(5, 4, 6), **settings))
    return replace(scene, render=replace(scene.render, tolerance=0))


def leaves_of(scene, factor=1.0):
    return {name: (factor * value_of(scene, name)).detach().requires_grad_() for name in NAMES}


def compare(scene, *names):
    targets = {view.name: Target.of(view.image, None) for view in scene.views}
    return Comparison([scene.view(name) for name in names], targets)


def differentiate_plainly(scene, values, *names):
    return differentiate(scene, names, values, compare(scene, *names), SolveMemory())


def assert_same(objective, plain):
    torch.testing.assert_close(objective.loss, plain.loss, rtol=1e-10, atol=0)
    torch.testing.assert_close(objective.images, plain.images, rtol=1e-10, atol=1e-12)
    for name, bar in objective.gradients.items():
        close = 1e-9 * float(plain.gradients[name].abs().max())
        torch.testing.assert_close(bar, plain.gradients[name], rtol=0, atol=close, msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["warp"], indirect=True)
def test_replays_are_plain_iterations(scene):
    """Of other values and views than those that were recorded, and after other views."""
    memory = SolveMemory()
    differentiate(scene, ["one"], leaves_of(scene), compare(scene, "one"), memory)
    # Volumes here differ by more than those of two iterations in a row.
    memory.iterations = {key: 2 * count for key, count in memory.iterations.items()}
    recording = Recording(scene, leaves_of(scene), memory, record)
    for factor, names in ((1.0, ["one", "two"]), (0.9, ["two", "one"]), (1.1, ["three"])):
        values, compared = leaves_of(scene, factor), compare(scene, *names)
        objective = recording.replay(values, compared, memory)
        assert compared.read(objective, objective.loss, []) is not None
        assert_same(objective, differentiate_plainly(scene, values, *names))
        assert list(compared.pictures) == names


def test_a_solve_that_needs_more_iterations_is_told(scene):
    memory = SolveMemory()
    differentiate(scene, ["one"], leaves_of(scene), compare(scene, "one"), memory)
    memory.iterations = dict.fromkeys(memory.iterations, 1)
    replays = Replays(scene, lambda: record)
    values, compared = leaves_of(scene, 0.5), compare(scene, "one")
    objective = replays.differentiate(values, compared, memory)
    assert objective.residuals and compared.read(objective, objective.loss, []) is None
    replays.forget(compared, memory)
    objective = replays.differentiate(values, compared, memory)
    assert not objective.residuals
    assert_same(objective, differentiate_plainly(scene, values, "one"))
    assert len(compared.psnrs) == 1


def test_what_cannot_be_recorded_runs_plainly(scene, caplog):
    """A camera that is sought looks at other rays in each iteration."""
    caplog.set_level("WARNING", LOG)  # a quiet command before this would have no warnings
    memory, values = SolveMemory(), leaves_of(scene)
    name = "views.one.camera"
    values[name] = value_of(scene, name).clone().requires_grad_()
    replays = Replays(scene, lambda: record)
    for _ in range(2):
        objective = replays.differentiate(values, compare(scene, "one"), memory)
    assert replays.new_recorder is None
    assert "without CUDA graphs" in caplog.text
    assert_same(objective, differentiate_plainly(scene, values, "one"))


@pytest.mark.slow
def test_a_recorded_run_goes_on_from_its_state_to_the_same_bits(coarse_ball):
    """It records anew what the whole run has recorded before."""
    use_engine("warp")
    render = replace(coarse_ball.render, tolerance=0)
    whole, resumed = (Reconstruction(replace(coarse_ball, render=render)) for _ in range(2))

    recorded = list[Reconstruction]()

    def advance(run, count):
        def new_recorder():
            recorded.append(run)
            return record

        for _ in range(count):
            run.frames[0].replays.new_recorder = new_recorder
            run.step()

    advance(whole, 3)
    resumed.restore(copy.deepcopy(whole.state()))
    for run in (whole, resumed):
        advance(run, 1)
        assert run in recorded
    assert torch.equal(whole.parameters[0].value, resumed.parameters[0].value)
