"""What ddrecon does on a device of its own, which refuses what CUDA would, and on a GPU if any."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from far_device import FAR, near_kernels
from torch import Tensor
from torch._subclasses import fake_tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.engine import ENGINES, use_engine
from ddrecon.reconstruct.frame import Result
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.reconstruct.loop import optimize
from ddrecon.scene import View
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import value_of, variable_names

pytestmark = pytest.mark.usefixtures("shapes_by_python", "few_directions")
# Before torch 2.13 it was a RuntimeError.
MISMATCH = getattr(fake_tensor, "FakeTensorDeviceMismatchError", RuntimeError)
CONFIGS = Path(__file__).parents[1] / "configs"
DEVICES = [FAR, *map(torch.device, ["cuda"] * torch.cuda.is_available())]
# Of one camera and one lamp, what capture.yaml seeks of each.
CAPTURE = (
    "optimize.parameters={density: {init: 0, min: 0, support: auto, support_margin: 4},"
    " lights.0.irradiance: {}, views.cam_0.exposure: {}, views.cam_0.camera: {}}"
)
EVERY_RAY = "render.tolerance=0"
"""A processor interpolates pixels that are finer than cells, and a GPU does not."""
Operation = Callable[[Tensor, Tensor], Any]
OPERATIONS: dict[str, Operation] = {
    "sum": lambda far, near: far + near,
    "sum with a number": lambda far, near: far * near[0] + 2 * near[1],
    "sum with a number there": lambda far, near: near + far.sum(),
    "in place": lambda far, near: near.add_(far),
    "in place by a number": lambda far, near: far.add_(near[0]),
    "in place by a number there": lambda far, near: near.add_(far.sum()),
    "out": lambda far, near: torch.add(far, far, out=near),
    "out there": lambda far, near: torch.add(near, near, out=far),
    "product": lambda far, near: far @ near,
    "join": lambda far, near: torch.cat([far, near]),
    "choice": lambda far, near: torch.where(near > 0, far, far),
    "choice of a number": lambda far, near: torch.where(far > 0, far, near[0]),
    "mask": lambda far, near: far.masked_fill(near > 0, 0.0),
    "mask by a number": lambda far, near: far.masked_fill(far > 0, near[0]),
    "clamp": lambda far, near: far.clamp(near[0], near[1]),
    "places": lambda far, near: far.index_select(0, near.long()),
    "gather": lambda far, near: far.gather(0, near.long()),
    "scatter": lambda far, near: far.index_add(0, far.long(), near),
    "copies": lambda far, near: near.copy_(far) + far.cpu(),
}


def is_refused(operation: Operation, far: Tensor, near: Tensor) -> bool:
    try:
        operation(far, near)
    except (MISMATCH, RuntimeError) as error:
        assert "same device" in str(error) or "two devices" in str(error)
        return True
    return False


@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS)
def test_operations_are_refused_as_torch_refuses_them_on_cuda(operation: Operation) -> None:
    with FakeTensorMode():
        expected = is_refused(operation, torch.zeros(3, device="cuda"), torch.zeros(3))
    assert is_refused(operation, torch.zeros(3, device=FAR), torch.zeros(3)) == expected


def test_indices_and_masks_go_to_the_device_and_not_back() -> None:
    """FakeTensor lets them pass; the rule is that of ATen's `IndexingUtils.h` and its message."""
    near = torch.arange(3.0)
    far = near.to(FAR)
    at, seen = torch.tensor([0, 2]), near > 0
    assert far[at].tolist() == far[at.to(FAR)].tolist() == [0.0, 2.0]
    assert far[seen].tolist() == far[[1, 2]].tolist() == [1.0, 2.0]
    far[seen] = 5.0
    far[at] = near[1]
    assert far.tolist() == [1.0, 5.0, 1.0]
    for refused in (at, seen):
        with pytest.raises(RuntimeError, match="same device"):
            near[refused.to(FAR)]
        with pytest.raises(RuntimeError, match="same device"):
            near[refused.to(FAR)] = 1.0
        with pytest.raises(RuntimeError, match="two devices"):
            far[refused] = near[:2]


def run(device: torch.device) -> Result:
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
def engine(request: pytest.FixtureRequest) -> str:
    if request.param == "warp":
        pytest.importorskip("warp")
    use_engine(request.param)
    return request.param


def kernels_for(device: torch.device, engine: str) -> contextlib.AbstractContextManager[None]:
    return near_kernels() if device == FAR and engine == "warp" else contextlib.nullcontext()


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES, ids=str)
def test_iterations_there_find_what_they_find_on_the_processor(
    device: torch.device, engine: str
) -> None:
    with kernels_for(device, engine):
        there = run(device)
    here = run(torch.device("cpu"))
    assert there.scene.volume.density.device.type == device.type
    for one, other in zip(there.rows, here.rows, strict=True):
        assert one.loss == pytest.approx(other.loss, rel=1e-4)
        assert one.test_psnr == pytest.approx(other.test_psnr, abs=1e-2)


def mean_square(_: View, image: Tensor) -> Tensor:
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
def test_every_kind_of_derivative_is_found_there(
    name: str, device: torch.device, engine: str
) -> None:
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
