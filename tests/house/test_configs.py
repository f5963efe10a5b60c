"""Every scene under configs/ loads, and renders small."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest

from ddrecon.picture import render
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.scene_file.build import load_scene

FOLDER = Path(__file__).parents[2] / "configs"
CONFIGS = sorted(path for path in FOLDER.rglob("*.yaml") if path.stem != "cloud")
"""But the one whose volume is for its user to download."""

NEEDS = {"mie": "miepython", ".exr": "OpenImageIO"}
"""What configs with these words need."""


@pytest.mark.usefixtures("few_directions")
@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: config.stem)
def test_a_config_renders(config):
    """In about 8 cells along its shortest side, and a picture as much coarser."""
    text = config.read_text()
    for word, package in NEEDS.items():
        if word in text and importlib.util.find_spec(package) is None:
            pytest.skip(f"needs {package}")
    is_small = config.parent.stem == "kinds" and "image:" not in text
    sizes = ["views.0.camera.resolution=[5, 4]"] if is_small else []
    scene = load_scene(config, overrides=sizes)
    scene = replace(scene, views=scene.views[:1])
    scene = scene_at_level(scene, max(1, min(scene.volume.grid.shape) // 8))
    picture = render(scene)
    assert bool(picture.isfinite().all()) and float(picture.min()) >= 0
    assert not scene.volume.density.any() or float(picture.max()) > 0
