"""What a result does not depend on: run, threads, order of views, chunks; little on precision."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from media import random_values
from small_scene import write_scene
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.reconstruct.gradients import differentiate
from ddrecon.reconstruct.loop import optimize
from ddrecon.scene import Scene, View
from ddrecon.scene_file.build import load_scene

pytestmark = pytest.mark.slow

EQUAL = 1e-5
"""Relative difference that the number of threads may make."""
SINGLE = 1e-4
"""Relative error of single precision, of images and of derivatives."""


NUMBERS = ["optimize.parameters.g={init: 0.1}", "views.1.split=train"]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_scene(tmp_path)


def cloud(
    path: Path, dtype: torch.dtype = torch.float32, cells: str = "[12, 10, 9]", **settings: str
) -> Scene:
    """The small scene, not so small, with a lumpy density."""
    overrides = [f"volume.resolution={cells}", "render.tolerance=0"]
    overrides += ["diffusion.tolerance=1e-6", "diffusion.transport_rounds=1"]
    overrides += [f"{key}={value}" for key, value in settings.items()]
    scene = load_scene(path, overrides=overrides, dtype=dtype)
    density = random_values(*scene.volume.grid.shape, dtype=dtype)
    return replace(scene, volume=replace(scene.volume, density=density))


def found(scene: Scene) -> dict[str, Tensor]:
    """Images of all views by name, and the derivatives of a loss by density, g and sigma_s."""
    varied = ("density", "g", "sigma_s")
    values = {name: getattr(scene.volume, name).clone().requires_grad_() for name in varied}
    names = [view.name for view in scene.views]

    def loss_of(_: View, image: Tensor) -> Tensor:
        return image.square().sum()

    result = differentiate(scene, names, values, loss_of, SolveMemory())
    return dict(zip(names, result.images, strict=True)) | {
        f"by {name}": bar for name, bar in result.gradients.items()
    }


def distance(one: dict[str, Tensor], other: dict[str, Tensor]) -> float:
    """The largest relative difference, of norms, between results of the same names."""
    assert one.keys() == other.keys()
    pairs = [(one[name].double(), other[name].double()) for name in one]
    return max(float((a - b).norm() / b.norm()) for a, b in pairs)


def test_a_run_has_the_same_bits_each_time_whatever_the_seed(path: Path) -> None:
    scene, runs = load_scene(path, overrides=[*NUMBERS, "optimize.iterations=5"]), []
    for seed in (3, 4):
        torch.manual_seed(seed)
        result = optimize(scene)
        losses = torch.tensor([row.loss for row in result.rows])
        runs.append([result.scene.volume.density, result.scene.volume.g, losses])
    assert all(torch.equal(one, other) for one, other in zip(*runs, strict=True))


def test_the_order_of_views_changes_no_reconstruction(path: Path) -> None:
    scene = load_scene(path, overrides=[*NUMBERS, "optimize.iterations=2"], dtype=torch.float64)
    turned = replace(scene, views=scene.views[::-1])
    one, other = (optimize(each).scene.volume for each in (scene, turned))
    assert torch.allclose(one.density, other.density, rtol=EQUAL)
    assert torch.allclose(one.g, other.g, rtol=EQUAL)


@pytest.mark.parametrize("model", ["flux_limited", "p1"])
def test_single_precision_is_close_to_double(path: Path, model: str) -> None:
    settings = {"diffusion.model": model}
    settings |= {"diffusion.transport_rounds": "0"} if model == "flux_limited" else {}
    single, double = (
        found(cloud(path, dtype, cells="[7, 6, 5]", **settings))
        for dtype in (torch.float32, torch.float64)
    )
    assert distance(single, double) < SINGLE
