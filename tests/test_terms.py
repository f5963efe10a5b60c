"""The physics that a scene is said to need is what its pictures show."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from media import make_scene, random_values, tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light.ground import Ground, Plane
from ddrecon.light.lights import (
    AmbientLight,
    BeamLight,
    DirectionalLight,
    EnvironmentLight,
    PointLight,
)
from ddrecon.lighting import solve_light
from ddrecon.medium.phase import HenyeyGreenstein
from ddrecon.picture import view_picture
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.terms import needed_terms

ABOVE, DOWN = tensor(0.1, 2.0, 0.1), tensor(-0.1, -1.0, 0.1)
LIGHTS: dict[str, Callable[[torch.Tensor], Any]] = {
    "sun": lambda color: DirectionalLight(DOWN, color),
    "ambient": lambda color: AmbientLight(color),
    "sky": lambda color: EnvironmentLight(
        color.view(-1, 1, 1).expand(-1, 2, 3), *tensor(1.0, 0.0), directions=6
    ),
    "lamp": lambda color: PointLight(ABOVE, color),
    "beam": lambda color: BeamLight(ABOVE, DOWN, color, tensor(0.2)[0]),
}


def color_part(part: str, color: torch.Tensor) -> Scene:
    """A scene that is gray but for one `part`, of a `color` [1] or [3]."""
    scene = make_scene(random_values(3, 4, 3), sigma_a=(0.5,), sigma_s=(3.0,), ambient=(0.3,))
    volume, (view,) = scene.volume, scene.views
    if part in LIGHTS:
        return replace(scene, lights=[LIGHTS[part](color)])
    if part == "ground":
        return replace(scene, ground=Ground(0.2 * color, Plane(volume.grid.lower[1], 1)))
    if part == "phase":
        return replace(scene, volume=replace(volume, phase=HenyeyGreenstein(0.2 * color)))
    if part in ("exposure", "offset"):
        return replace(scene, views=[replace(view, **{part: color})])
    if part == "background":
        return replace(scene, views=[replace(view, background=color.view(-1, 1, 1))])
    return replace(scene, volume=replace(volume, **{part: color}))


VOLUME = "sigma_a", "sigma_s", "phase", "emission", "black_body"
VIEW = "exposure", "offset", "background"


@pytest.mark.parametrize("part", [*LIGHTS, *VOLUME, "ground", *VIEW])
def test_all_is_gray_where_pictures_are(part: str) -> None:
    for color in (tensor(1.5), tensor(1.0, 2.0, 3.0)):
        scene = color_part(part, color)
        picture = view_picture(solve_light(scene, SolveMemory()), scene, scene.views[0])
        is_gray = bool(torch.allclose(picture, picture.mean(0)))
        assert is_gray == (len(color) == 1)
        assert needed_terms(scene)[0].startswith("1 color channel (all is gray)") == is_gray


SCENE = """
volume:
  bounds: {min: [0, 0, 0], max: [1, 2, 4]}
  resolution: [10, 10, 10]
  density: 1
  sigma_t: [1, 2, 4]
  albedo: 0.9
lights: [{type: directional, direction: [1, 0, 0], irradiance: 1}]
views:
  - {name: view, camera: {type: perspective, origin: [4, 0, 0], target: [0, 0, 0], up: [0, 1, 0],
     fov: 30, resolution: [2, 2]}}
"""
AS_GIVEN = "diffusion.refine=1"
MEAN_SIDE = (0.1 + 0.2 + 0.4) / 3


@pytest.mark.parametrize("depth", [0.7, 0.8])
def test_two_where_a_cell_is_thick(tmp_path: Path, depth: float) -> None:
    """The densest color decides, across a cell's mean side; `check` says so."""
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    scene = load_scene(path, overrides=[f"volume.density={depth / (4 * MEAN_SIDE)}", AS_GIVEN])
    steps = 1 if depth < 0.75 else 2
    assert scene.render.steps == steps
    samples = "1 sample" if steps == 1 else "2 samples"
    assert f"view rays: {samples} a cell of at most {depth} optical depths" in needed_terms(scene)
    asked = load_scene(path, overrides=["render.steps_per_voxel=3", "volume.density=9"])
    assert asked.render.steps == 3
