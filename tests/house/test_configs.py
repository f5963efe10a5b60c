"""Every scene under configs/ loads, and reconstructs on few cells from one picture."""

import importlib.util
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args

import pytest
import torch

from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.reconstruct.loop import optimize
from ddrecon.reconstruct.setup import select_views
from ddrecon.renderer import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.scene_file.schema import PhaseSection
from ddrecon.settings import DiffusionSettings, OptimizeSettings
from ddrecon.variables.values import value_of, variable_names

pytestmark = pytest.mark.usefixtures("few_directions")
ROOT = Path(__file__).parents[2]
CONFIGS = [
    config
    for config in sorted((ROOT / "configs").glob("*.yaml"))
    if config.stem not in ("gradcheck_all", "ground")
]
"""Those with images; the derivatives of the first other are checked in tests/validate."""

KINDS = [*sorted((ROOT / "configs" / "kinds").glob("*.yaml")), ROOT / "configs" / "ground.yaml"]


def small(config: Path) -> Scene:
    """The scene about 8 cells along its shortest side, and as much coarser in its pictures."""
    scene = load_scene(config, overrides=["optimize.iterations=2", "optimize.refine_at=[]"])
    return scene_at_level(
        replace(scene, views=[scene.views[0], scene.views[-1]]), min(scene.volume.grid.shape) // 8
    )


@pytest.mark.parametrize("config", KINDS, ids=lambda config: config.stem)
def test_a_kind_of_scene_renders(config: Path) -> None:
    if "mie" in config.read_text():
        pytest.importorskip("miepython", reason="needs the extra `mie`")
    sizes = ["views.0.camera.resolution=[5, 4]"] if "image:" not in config.read_text() else []
    scene = load_scene(config, overrides=sizes)
    picture = render(scene, scene.views[0].name)
    assert bool(picture.isfinite().all()) and float(picture.min()) >= 0 < float(picture.max())


def test_every_phase_function_model_and_loss_is_used() -> None:
    """By a config, or in the measurements of the paper's g."""
    used = [*(ROOT / "configs").rglob("*.yaml"), ROOT / "benchmarks" / "paper_g.py"]
    text = "".join(path.read_text() for path in used).replace("=", ": ")
    known = {f"type: {section.type}" for section in get_args(PhaseSection)}
    for field in (*fields(DiffusionSettings), *fields(OptimizeSettings)):
        if field.name in ("model", "loss"):
            known |= {f"{field.name}: {choice}" for choice in field.metadata["choices"]}
    # What scenes have that do not say.
    by_default = {"type: henyey_greenstein", "model: p1", "loss: l2", "loss: display"}
    assert {one for one in known if one not in text} <= by_default


@pytest.mark.slow
@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.stem)
def test_a_config_runs_small(config: Path) -> None:
    if ".exr" in config.read_text() and importlib.util.find_spec("OpenImageIO") is None:
        pytest.skip("its images need OpenImageIO")
    scene = small(config)
    known = variable_names(select_views(scene, is_test=False))
    parameters = {name: given for name, given in scene.optimize.parameters.items() if name in known}
    scene.optimize = replace(scene.optimize, parameters=parameters)
    result = optimize(scene)
    name = next(iter(parameters))
    found = value_of(result.scene, name)
    assert [row.iteration for row in result.rows] == [1, 2]
    assert result.rows[1].psnr > result.rows[0].psnr
    assert torch.isfinite(found).all() and found.min() >= 0 and (found != scene.starts[name]).any()
