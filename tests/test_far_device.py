"""What ddrecon does on a device of its own, which refuses what CUDA would, and on a GPU if any."""

import contextlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from far_device import FAR, near_kernels

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.loop import optimize
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import value_of, variable_names

pytestmark = pytest.mark.usefixtures("shapes_by_python", "few_directions")
CONFIGS = Path(__file__).parents[1] / "configs"
DEVICES = [FAR, *map(torch.device, ["cuda"] * torch.cuda.is_available())]
# Of one camera and one lamp, what capture.yaml seeks of each.
CAPTURE = (
    "optimize.parameters={density: {init: 0, min: 0, support: auto, support_margin: 4},"
    " lights.0.irradiance: {}, views.cam_0.exposure: {}, views.cam_0.camera: {}}"
)
EVERY_RAY = "render.tolerance=0"
"""A processor interpolates pixels that are finer than cells, and a GPU does not."""


def run(device):
    """Two iterations; rounds are among the derivatives below."""
    overrides = ["diffusion.tolerance=0.01", CAPTURE]
    overrides += ["diffusion.transport_rounds=0", EVERY_RAY]
    path = CONFIGS / "capture.yaml"
    scene = load_scene(path, overrides=overrides, dtype=torch.float64, device=device)
    views = {view.is_test: view for view in reversed(scene.views)}
    few = [view for view in scene.views if view in views.values() or view is scene.views[1]]
    torch.manual_seed(0)
    return optimize(scene_at_level(replace(scene, views=few), 16), 2)


@pytest.fixture(params=ENGINES)
def engine(request):
    if request.param == "warp":
        pytest.importorskip("warp")
    use_engine(request.param)
    return request.param


def kernels_for(device, engine):
    return near_kernels() if device == FAR and engine == "warp" else contextlib.nullcontext()


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES, ids=str)
def test_iterations_there_find_what_they_find_on_the_processor(device, engine):
    with kernels_for(device, engine):
        there = run(device)
    here = run(torch.device("cpu"))
    assert there.scene.volume.density.device.type == device.type
    for one, other in zip(there.rows, here.rows, strict=True):
        assert one.loss == pytest.approx(other.loss, rel=1e-4)
        assert one.test_psnr == pytest.approx(other.test_psnr, abs=1e-2)


def mean_square(_, image):
    return image.square().mean()


ALL, CLOUD = "gradcheck_all", "kinds/measured_phase"
SMALL = ["volume.resolution=[3, 4, 3]", "volume.density=0.5"]
EVERY_KIND = ["lights.2.directions=2", "diffusion.transport_rounds=1", "diffusion.degree=1"]
GROUND = ["diffusion.transport_rounds=0", "optimize.parameters={density: {}, ground.albedo: {}}"]
GROUND += ["lights=[{type: directional, direction: [-1, -2, -1], irradiance: 3}]"]
CASES = {
    "every kind": (ALL, EVERY_KIND),
    "ground": (ALL, GROUND),
    "phase by a table": (CLOUD, ["optimize={parameters: {density: {}}}"]),
}


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES, ids=str)
@pytest.mark.parametrize("name", CASES)
def test_every_kind_of_derivative_is_found_there(name, device, engine):
    config, overrides = CASES[name]
    found = []
    for place in (device, torch.device("cpu")):
        with kernels_for(place, engine):
            kind = {"dtype": torch.float64, "device": place}
            path = CONFIGS / f"{config}.yaml"
            scene = load_scene(path, overrides=[*SMALL, *overrides, EVERY_RAY], **kind)
            scene = scene if overrides is GROUND else replace(scene, ground=None)
            names = scene.optimize.parameters.keys() & set(variable_names(scene))
            values = {name: value_of(scene, name).requires_grad_() for name in names}
            names = [view.name for view in scene.views]
            gone_back = differentiate(scene, names, values, mean_square, SolveMemory())
            found.append({name: one.cpu() for name, one in gone_back.gradients.items()})
    for name, there in found[0].items():
        torch.testing.assert_close(there, found[1][name], rtol=1e-6, atol=1e-12)
