"""Every scene under configs/ loads, and what it makes small is differentiated on few cells."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from media import random_values
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.picture import render
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.setup import Problem, scene_at_level, select_views, start_parameters
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.kinds import kind_of, unit_of
from ddrecon.variables.values import variable_names, with_values

pytestmark = pytest.mark.usefixtures("few_directions")
ROOT = Path(__file__).parents[2]
CONFIGS = [
    config
    for config in sorted((ROOT / "configs").glob("*.yaml"))
    if config.stem not in ("gradcheck_all", "ground", "cloud")
]
"""Those with images; the derivatives of the first other are checked in tests/validate."""

STEP = 1e-5
"""A part of a change, so small that no kink is crossed: light's way through cells has some."""
KINDS = [*sorted((ROOT / "configs" / "kinds").glob("*.yaml")), ROOT / "configs" / "ground.yaml"]


def small(config):
    """The scene about 8 cells along its shortest side, and as much coarser in two pictures."""
    closely = ["diffusion.tolerance=1e-13"]
    scene = load_scene(config, overrides=closely, dtype=torch.float64)
    scene = replace(scene, views=[scene.views[0], scene.views[-1]])
    scene = scene_at_level(scene, min(scene.volume.grid.shape) // 8)
    known = variable_names(select_views(scene, is_test=False))
    sought = {name: one for name, one in scene.optimize.parameters.items() if name in known}
    return replace(scene, optimize=replace(scene.optimize, parameters=sought))


@pytest.mark.parametrize("config", KINDS, ids=lambda config: config.stem)
def test_a_kind_of_scene_renders(config):
    if "mie" in config.read_text():
        pytest.importorskip("miepython", reason="needs the extra `mie`")
    sizes = ["views.0.camera.resolution=[5, 4]"] if "image:" not in config.read_text() else []
    scene = load_scene(config, overrides=sizes)
    scene = scene_at_level(scene, max(1, min(scene.volume.grid.shape) // 8))
    picture = render(scene, scene.views[0].name)
    assert bool(picture.isfinite().all()) and float(picture.min()) >= 0 < float(picture.max())


@pytest.mark.slow
@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.stem)
def test_the_derivative_of_what_a_config_makes_small_is_its_difference(config):
    """By all that it seeks, each of which its pictures tell something of, near where it starts."""
    if ".exr" in config.read_text() and importlib.util.find_spec("OpenImageIO") is None:
        pytest.skip("its images need OpenImageIO")
    problem = Problem.of(small(config))
    level, values, ways = problem.at(0), dict[str, Tensor](), dict[str, Tensor]()
    for one in start_parameters(problem.train, problem.settings):
        start = one.value.detach()
        kind = kind_of(one.name)
        change = 1.7 * unit_of(problem.train, one.name)
        if not kind.is_cellwise:
            change = kind.change(problem.train, one.name, start)
        way = change * (0.5 + random_values(*start.shape))
        ways[one.name] = torch.where(start + 2 * way < one.high, way, -way)
        values[one.name] = start + ways[one.name]

    def loss_of(view, image):
        return level.targets[view.name].loss_of(image)

    def loss_at(step):
        moved = {name: value + step * ways[name] for name, value in values.items()}
        world = with_values(level.train, moved)
        with torch.no_grad():
            images = zip(world.views, render(world), strict=True)
            return sum(float(loss_of(*each)) for each in images)

    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    names = [view.name for view in level.train.views]
    gradients = differentiate(level.train, names, leaves, loss_of, SolveMemory()).gradients
    assert all(bool(gradient.any()) for gradient in gradients.values())
    slope = sum(float((gradient * ways[name]).sum()) for name, gradient in gradients.items())
    assert slope == pytest.approx((loss_at(STEP) - loss_at(-STEP)) / (2 * STEP), rel=1e-5)
