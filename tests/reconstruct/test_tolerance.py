"""Solves are no more exact than the gradient needs, and the gradient is as exact as promised."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.reconstruct.gradients import Differentiated, differentiate, solve_tolerances
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.tuning import GRADIENT_ERROR
from ddrecon.scene import Scene


def differentiated(scene: Scene, targets: dict[str, Tensor], memory: SolveMemory) -> Differentiated:
    density = torch.full_like(scene.volume.density, 0.3).requires_grad_()

    def loss_of(view, image: Tensor) -> Tensor:
        return (image - targets.get(view.name, 0)).square().sum()

    return differentiate(
        scene, [view.name for view in scene.views], {"density": density}, loss_of, memory
    )


@pytest.mark.slow
@pytest.mark.parametrize("misfit", [1.0, 0.01])
def test_the_gradient_is_as_exact_as_promised(misfit: float, ball_scene: Scene):
    """Towards pictures that differ from the images by `misfit` of their size."""
    scene = replace(ball_scene, diffusion=replace(ball_scene.diffusion, tolerance=1e-6))
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
def test_a_run_solves_as_its_last_misfit_asks_and_test_views_as_the_scene_does(ball_scene: Scene):
    changes = {"transport_rounds": 1, "tolerance": 1e-6, "warm_start": False}
    scene = replace(ball_scene, diffusion=replace(ball_scene.diffusion, **changes))
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
