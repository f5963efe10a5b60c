"""How many samples a cell view rays get where a scene file leaves that out."""

from pathlib import Path

import pytest

from ddrecon.scene_file.build import load_scene
from ddrecon.terms import needed_terms

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
