"""What a scene leaves out is chosen by its medium, whoever wrote the scene: a file or Python."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ddrecon.layer import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import DiffusionSettings, RenderSettings
from ddrecon.variables.values import with_values

BALL = Path(__file__).parents[1] / "configs" / "ball.yaml"
SMALL = ["optimize=null", "volume.resolution=[3, 2, 3]", "volume.density=1", "volume.sigma_s=1"]
SMALL += [
    "diffusion.tolerance=0.1",
    "views=[{name: front, camera: {type: perspective, origin: [0, 0.2, 3], target: [0, 0, 0],"
    " fov: 30, resolution: [2, 2]}}]",
]
MEDIA = (
    "volume={bounds: {min: [-0.5, -0.5, -0.5], max: [0.5, 0.5, 0.5]}, resolution: [3, 2, 2], media:"
    " {smoke: {density: 1, sigma_a: 1, sigma_s: 3, g: 0.5},"
    " air: {density: 1, sigma_a: 0, sigma_s: 1, phase: {type: rayleigh}}}}"
)
KINDS = {
    "thick cells": ["volume.sigma_s=4"],
    "a strong forward peak": ["volume.g=0.85"],
    "a glow": ["volume.density=0.1", "volume.emission=1"],
    "periods": ["volume.periodic=[x]"],
    "an index": ["volume.index=1.4"],
    "two media": [MEDIA],
    "density that is sought": ["optimize={parameters: {density: {}}}"],
}


@pytest.mark.parametrize("overrides", KINDS.values(), ids=KINDS)
def test_a_scene_made_in_python_is_that_of_its_file(overrides: list[str]) -> None:
    loaded = load_scene(BALL, overrides=[*SMALL, *overrides])
    settings = DiffusionSettings(tolerance=loaded.diffusion.tolerance)
    parts = loaded.volume, loaded.lights, loaded.views
    made = Scene(*parts, diffusion=settings, optimize=loaded.optimize)
    assert (made.diffusion, made.render, made.reason) == (
        loaded.diffusion,
        loaded.render,
        loaded.reason,
    )
    assert torch.equal(render(made), render(loaded))
    assert (made.diffusion, made.render) != (settings, RenderSettings())


def test_what_was_chosen_stays_when_the_medium_changes() -> None:
    """So a loss has no steps where a thicker medium would be given more rounds."""
    scene = load_scene(BALL, overrides=SMALL)
    thick = with_values(scene, {"density": 100 * scene.volume.density})
    assert (thick.diffusion, thick.render) == (scene.diffusion, scene.render)
    fresh = replace(scene, volume=thick.volume, diffusion=DiffusionSettings())
    assert fresh.diffusion != replace(scene.diffusion, tolerance=fresh.diffusion.tolerance)
