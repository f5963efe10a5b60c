"""Steps in which all that is sought moves together, on two small views of a known volume."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from media import make_camera, make_scene, random_values
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import Target
from ddrecon.reconstruct.curvature import Curvature
from ddrecon.reconstruct.gauges import find_gauges
from ddrecon.reconstruct.joint import moves_together, step_together
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.schedule import Schedule
from ddrecon.renderer import render_each
from ddrecon.scene import Scene, View
from ddrecon.settings import OptimizeSettings, ParameterSettings

SIZE = (6, 8)
EYES = {"one": (0.2, 0.3, 2.5), "two": (2.4, -0.3, 0.5)}
NAMES = ("density", "views.one.exposure", "views.two.exposure")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Two views of a volume, whose pictures are those of exposures 1.3 and 1 / 1.3."""
    density = 0.4 + random_values(4, 4, 4)
    medium = {"sigma_a": (0.1,), "sigma_s": (1.0,)}
    world = make_scene(density, **medium, ambient=(0.2,), transport_rounds=0)
    gains = dict(zip(EYES, (1.3, 1 / 1.3), strict=True))
    views = [
        View(name, make_camera(eye, SIZE), exposure=density.new_tensor([gains[name]]))
        for name, eye in EYES.items()
    ]
    images = render_each(replace(world, views=views), views, SolveMemory())
    one = density.new_ones(1)
    shown = [replace(v, image=i, exposure=one) for v, i in zip(views, images, strict=True)]
    return replace(world, views=shown)


def parameters_of(scene: Scene, density: Tensor, gain: float) -> list[Parameter]:
    starts = density, density.new_tensor([gain]), density.new_tensor([1 / gain])
    settings, grid = ParameterSettings(), scene.volume.grid
    found = [Parameter(n, settings, 0.1, x, grid) for n, x in zip(NAMES, starts, strict=True)]
    found[0].tv = 0.0
    return found


def step(scene: Scene, parameters: list[Parameter]) -> tuple[float, float]:
    """The objective before and after a step."""
    targets = {view.name: Target.of(view.image, None) for view in scene.views}

    def objective() -> float:
        images = Curvature(scene, parameters, targets, 1.0).images
        return float(sum(targets[name].loss_of(image) for name, image in images.items())) / 2

    before = objective()
    step_together(scene, parameters, targets, 1.0, find_gauges(scene, parameters), {})
    return before, objective()


def test_steps_find_exposures_that_a_volume_has_learned(scene: Scene) -> None:
    """The density of the cells is right but for a tilt that makes up for equal exposures."""
    tilt = torch.linspace(0.8, 1.2, 4, dtype=torch.float64)
    parameters = parameters_of(scene, scene.volume.density * tilt, 1.0)
    errors = []
    for _ in range(3):
        before, after = step(scene, parameters)
        assert after < before
        errors.append(abs(math.log(parameters[1].value.item() / 1.3)))
    assert after < 1e-3 * scene.views[0].image.square().mean()
    assert errors[-1] < 0.03


def test_the_gauge_is_held(scene: Scene) -> None:
    parameters = parameters_of(scene, scene.volume.density, 1.0)
    step(scene, parameters)
    product = parameters[1].value * parameters[2].value
    torch.testing.assert_close(product.detach(), torch.ones_like(product))


def test_nothing_moves_at_the_optimum(scene: Scene) -> None:
    parameters = parameters_of(scene, scene.volume.density, 1.3)
    before = {p.name: p.value for p in parameters}
    first, last = step(scene, parameters)
    assert last <= first < 1e-20
    for p in parameters:
        torch.testing.assert_close(p.value, before[p.name], rtol=1e-6, atol=1e-9)


def test_smoothing_moves_cells_alone(scene: Scene) -> None:
    """Where pictures are shown perfectly, numbers stay, however strongly fields are smoothed."""
    parameters = parameters_of(scene, scene.volume.density, 1.3)
    parameters[0].tv = 0.01
    before = {p.name: (p.value.detach(), float(p.penalty().detach())) for p in parameters}
    step(scene, parameters)
    assert float(parameters[0].penalty().detach()) < 0.99 * before["density"][1]
    for p in parameters[1:]:
        torch.testing.assert_close(p.value.detach(), before[p.name][0], rtol=1e-6, atol=0)


def test_only_runs_that_seek_cameras_and_a_field_take_them(scene: Scene) -> None:
    field, *gains = parameters_of(scene, scene.volume.density, 1.0)
    assert moves_together([field, *gains], "display")
    assert not moves_together([field], "display")
    assert not moves_together(gains, "display")
    assert not moves_together([field, *gains], "l1")


@pytest.mark.parametrize(("planned", "expected"), [(128, {62, 63, 126, 127}), (60, set())])
def test_it_is_the_last_iterations_of_each_resolution(planned: int, expected: set[int]) -> None:
    settings = OptimizeSettings({}, iterations=planned, refine_at=(0.5,))
    schedule = Schedule(settings, {}, is_joint=True)
    assert {i for i in range(planned) if schedule.moves_together(i)} == expected
