"""View by view or all at once, the derivative is the same; memory does not grow with views."""

from dataclasses import replace

import pytest
import torch
from media import make_scene, random_values
from scenes import three_views

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.picture import render_each
from ddrecon.reconstruct.gradients import differentiate, solve_tolerances
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.tuning import GRADIENT_ERROR
from ddrecon.settings import OptimizeSettings, ParameterSettings
from ddrecon.variables.values import value_of, with_values

SHAPE = (5, 4, 6)
NAMES = "density", "albedo", "g", "lights.0.irradiance", "lights.0.direction"
NAMES += "lights.1.radiance", "views.one.camera"


@pytest.fixture
def scene():
    return three_views(make_scene(random_values(*SHAPE), g=0.3, ambient=(0.2, 0.3, 0.4)))


def loss_of(view, image):
    return (image - view.image).square().mean()


def leaves_of(scene):
    return {name: value_of(scene, name).clone().requires_grad_() for name in NAMES}


def test_it_is_the_derivative_of_the_sum_over_views(scene):
    values = leaves_of(scene)
    found = differentiate(scene, ["one", "three"], values, loss_of, SolveMemory())
    world = with_values(scene, values)
    seen = [world.views[0], world.views[2]]
    images = render_each(world, seen, SolveMemory())
    loss = sum(loss_of(view, image) for view, image in zip(seen, images, strict=True))
    wanted = torch.autograd.grad(loss, list(values.values()))
    torch.testing.assert_close(found.loss, loss.detach(), rtol=1e-13, atol=0)
    for (name, gradient), bar in zip(found.gradients.items(), wanted, strict=True):
        close = 1e-12 * float(bar.abs().max())
        torch.testing.assert_close(gradient, bar, rtol=1e-9, atol=close, msg=name)
    assert all(map(torch.equal, found.images, images))


def test_one_adjoint_serves_all_views_and_parameters(scene):
    memory = SolveMemory()
    differentiate(scene, ["one", "two", "three"], leaves_of(scene), loss_of, memory)
    assert [record.kind for record in memory.records] == ["forward", "adjoint"]


def test_a_camera_nobody_looks_through_has_no_derivative(scene):
    name = "views.one.camera"
    values = {name: value_of(scene, name).requires_grad_()}
    found = differentiate(scene, ["two"], values, loss_of, SolveMemory())
    assert torch.equal(found.gradients[name], torch.zeros(6).double())


def with_derivatives(scene, kind):
    parameters = {name: ParameterSettings() for name in NAMES}
    return replace(scene, optimize=OptimizeSettings(parameters, derivatives=kind))


def test_only_the_diffusion_needs_an_adjoint(scene):
    memory = SolveMemory()
    differentiate(with_derivatives(scene, "single"), ["one"], leaves_of(scene), loss_of, memory)
    assert [record.kind for record in memory.records] == ["forward"]


def differentiated(scene, targets, memory):
    density = torch.full_like(scene.volume.density, 0.3).requires_grad_()

    def loss_of(view, image):
        return (image - targets.get(view.name, 0)).square().sum()

    return differentiate(
        scene, [view.name for view in scene.views], {"density": density}, loss_of, memory
    )


@pytest.mark.slow
@pytest.mark.parametrize("misfit", [1.0, 0.01])
def test_the_gradient_is_as_exact_as_promised(misfit, coarse_ball):
    """Towards pictures that differ from the images by `misfit` of their size."""
    scene = replace(coarse_ball, diffusion=replace(coarse_ball.diffusion, tolerance=1e-6))
    images = differentiated(scene, {}, SolveMemory()).images
    signs = [torch.where(torch.arange(image.shape[-1]) % 2 == 0, 1.0, -0.5) for image in images]
    changed = [image * (1 - misfit * sign) for image, sign in zip(images, signs, strict=True)]
    targets = dict(zip([view.name for view in scene.views], changed, strict=True))
    exact, loose = SolveMemory(), SolveMemory(tolerance_floor=solve_tolerances(misfit))
    known, found = (
        differentiated(scene, targets, memory).gradients["density"] for memory in (exact, loose)
    )
    assert float((found - known).norm()) < GRADIENT_ERROR * float(known.norm())
    few, many = (sum(one.iterations for one in memory.records) for memory in (loose, exact))
    assert few < many


@pytest.mark.slow
def test_a_run_solves_as_its_last_misfit_asks_and_test_views_as_the_scene_does(coarse_ball):
    changes = {"transport_rounds": 1, "tolerance": 1e-6, "warm_start": False}
    scene = replace(coarse_ball, diffusion=replace(coarse_ball.diffusion, **changes))
    run = Reconstruction(scene, 3)
    while not run.is_done:
        asked = solve_tolerances(run.frames[0].misfit)
        run.step()
        solves = [record for record in run.memory.records if record.kind != "rounds"]
        train, last = solves[:-2], solves[-2:]
        for record in train:
            least = asked[record.kind] / 100 if record.iterations else -1
            assert least < record.residual <= asked[record.kind]
    assert all(record.residual <= 1e-6 for record in last)  # diffusion's own, and the round's
    assert 0 < run.frames[0].misfit < 1
