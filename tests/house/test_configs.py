"""Every scene under configs/ loads, and reconstructs on few cells from one picture."""

from __future__ import annotations

import importlib.util
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ddrecon.reconstruct.loop import optimize
from ddrecon.reconstruct.setup import select_views
from ddrecon.scene_file.build import load_scene
from ddrecon.variables.values import variable_names

ROOT = Path(__file__).parents[2]
CONFIGS = [
    config for config in sorted((ROOT / "configs").glob("*.yaml")) if config.stem != "gradcheck_all"
]
"""Those with images to reconstruct from; the derivatives of the other are checked in
tests/validate.
"""


def small(config: Path) -> list[str]:
    """Overrides that leave the config about 8 cells along its shortest side."""
    (sizes,) = re.findall(
        r"^  resolution: \[(\d+), (\d+), (\d+)\]", config.read_text(), re.MULTILINE
    )
    cells = [int(size) for size in sizes]
    return [
        f"volume.resolution={[size * 8 // min(cells) for size in cells]}",
        "optimize.iterations=2",
    ]


def test_there_are_configs() -> None:
    assert {"ball", "plume"} <= {config.stem for config in CONFIGS}


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.stem)
def test_a_config_runs_small(config: Path) -> None:
    if ".exr" in config.read_text() and importlib.util.find_spec("OpenImageIO") is None:
        pytest.skip("its images need OpenImageIO")
    scene = load_scene(config, overrides=small(config))
    scene.views = [scene.views[0], scene.views[-1]]
    known = variable_names(select_views(scene, is_test=False))
    parameters = {name: given for name, given in scene.optimize.parameters.items() if name in known}
    scene.optimize = replace(scene.optimize, parameters=parameters)
    result = optimize(scene)
    density = result.scene.volume.density
    assert [row.iteration for row in result.rows] == [1, 2]
    assert result.rows[1].psnr > result.rows[0].psnr
    assert (
        torch.isfinite(density).all()
        and density.min() >= 0
        and (density != scene.starts["density"]).any()
    )
