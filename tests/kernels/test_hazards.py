"""What could go wrong between kernels and tensors: layouts in memory, modes of torch, threads."""

import math
import multiprocessing
import threading

import pytest
import torch
from media import half_empty, make_scene
from scenes import cloud, mixture
from twins import assert_same, differentiate, images_of, values_of

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.errors import SolveError
from ddrecon.light.reduced import follow_lights, receive_light, sum_unscattered_sky
from ddrecon.light.sky import decompose_lights
from ddrecon.medium.coefficients import scale_medium
from ddrecon.picture import render_each
from ddrecon.variables.values import with_values

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.kernels import launch

pytestmark = pytest.mark.slow

SHAPE = (5, 7, 9)
FIELDS = "density", "sigma_a", "sigma_s"
VARIED = {cloud: (*FIELDS, "g"), mixture: (*FIELDS, "phase.g")}


def reorder(tensor):
    """The same numbers, stored as Fortran would."""
    axes = list(reversed(range(tensor.ndim)))
    return tensor.permute(axes).contiguous().permute(axes)


@pytest.mark.parametrize("make", [cloud, mixture])
def test_layout_in_memory_changes_nothing(make):
    scene = make()
    values = values_of(scene, VARIED[make])
    known = differentiate("torch", images_of(scene), values)
    reordered = {name: reorder(value) for name, value in values.items()}
    assert_same(differentiate("warp", images_of(scene), reordered), known, 1e-12)


@pytest.mark.parametrize("make", [cloud, mixture])
def test_the_same_threads_give_the_same_bits_and_others_the_same_numbers(make, monkeypatch):
    # However few cells and pixels there are, threads share them.
    monkeypatch.setattr("ddrecon.diffusion.fused.passes.SMALL", 0)
    scene, threads, runs = make(), torch.get_num_threads(), []
    values = values_of(scene, VARIED[make])
    try:
        for count in (2, 2, 1, 3, 16):
            torch.set_num_threads(count)
            runs.append(differentiate("warp", images_of(scene), values))
    finally:
        torch.set_num_threads(threads)
    assert_same(runs[1], runs[0], 0.0)
    for other in runs[2:]:
        assert_same(other, runs[0], 1e-12)


@pytest.mark.parametrize("engine", ENGINES)
def test_second_derivatives_are_refused(engine):
    """Rather than that parts of them are missing, whether the cotangent varies or not."""
    use_engine(engine)
    scene = cloud()
    density = scene.volume.density.clone().requires_grad_()
    (image,) = images_of(scene)({"density": density})
    for loss in (image.square().sum(), image.sum()):
        with pytest.raises(NotImplementedError, match="only first derivatives"):
            torch.autograd.grad(loss, density, create_graph=True)


def test_a_graph_can_be_gone_back_through_twice():
    use_engine("warp")
    scene = cloud()
    density = scene.volume.density.clone().requires_grad_()
    changed = with_values(scene, {"density": density})
    (image,) = render_each(changed, changed.views, SolveMemory(is_warm=False))
    once, again = (
        torch.autograd.grad(image.sum(), density, retain_graph=True)[0] for _ in range(2)
    )
    assert torch.equal(once, again)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("model", ["p1", "none"])
def test_a_density_that_is_no_number_is_seen(engine, model):
    use_engine(engine)
    density = half_empty(*SHAPE)
    density[2, 3, 4] = torch.nan
    scene = make_scene(density, g=0.4, model=model)
    if model == "p1":
        with pytest.raises(SolveError, match="tolerance") as raised:
            render_each(scene, scene.views, SolveMemory())
        assert math.isnan(raised.value.residual)
    else:
        (image,) = render_each(scene, scene.views, SolveMemory())
        assert not image.isfinite().all()


@pytest.mark.parametrize("engine", ENGINES)
def test_light_through_what_is_no_number_is_none(engine):
    """Where the mass up to a cell is not a number, no kernel makes one of the light there."""
    use_engine(engine)
    scene = cloud()
    scene.volume.density[1, 2, 3] = torch.nan
    medium, lights = scale_medium(scene.volume), decompose_lights(scene.lights)
    source = receive_light(medium, lights, degree=1).source
    sky = sum_unscattered_sky(medium, lights, degree=1)
    assert sky is not None and len(source) == len(sky) == 4
    assert bool(sky[0].isnan()[:, 1, 2, 3].all())
    for beam in follow_lights(medium, lights):
        is_unknown = beam.mass.isnan()
        assert 1 < is_unknown.sum() < is_unknown.numel()
        assert bool((source.isnan() | ~is_unknown).all())


def test_a_failing_share_waits_for_the_others(monkeypatch):
    like, started, done = torch.zeros(1), threading.Event(), threading.Event()

    def fake(_kernel, _size, arguments, **_):
        if arguments[0] == 0:
            started.wait(10)
            raise ValueError("no")
        started.set()
        threading.Event().wait(0.2)
        done.set()

    monkeypatch.setattr(launch.wp, "launch", fake)
    monkeypatch.setattr(launch, "load", lambda *_: None)
    with pytest.raises(ValueError, match="no"):
        launch.launch(None, 2, [None], like, threads=2)
    assert done.is_set()


def test_threads_are_there_after_a_fork():
    launch._pool(2).submit(int).result()
    process = multiprocessing.get_context("fork").Process(target=_ask_thread, daemon=True)
    process.start()
    process.join(20)
    assert process.exitcode == 0


def _ask_thread():
    launch._pool(2).submit(int).result(10)
