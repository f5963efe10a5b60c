"""A scene small enough to be reconstructed hundreds of times, with three kinds of parameters."""

from pathlib import Path

import numpy as np

SCENE = """\
volume:
  bounds: {min: [-0.5, -0.3, -0.3], max: [0.5, 0.3, 0.3]}
  resolution: [16, 4, 3]
  density: 0.2
  sigma_a: 0.5
  sigma_s: 6
  g: 0.3
lights:
  - {type: directional, direction: [-1, -2, -1], irradiance: 3}
views:
  - name: front
    image: front.npy
    camera: {type: perspective, origin: [0, 0, 2.5], target: [0, 0, 0], fov: 30, resolution: [8, 6]}
  - name: side
    image: side.npy
    camera: {type: perspective, origin: [2.5, 0, 0], target: [0, 0, 0], fov: 30, resolution: [8, 6]}
  - name: test
    image: side.npy
    split: test
    camera: {type: orthographic, origin: [-2.5, 0, 0], target: [0, 0, 0], width: 1,
             resolution: [8, 6]}
diffusion: {transport_rounds: 0}
optimize:
  iterations: 6
  parameters: {density: {init: 0.1, tv: 1e-3}, g: {init: 0.1}, views.front.camera: {}}
"""


def write_scene(folder: Path) -> Path:
    """Writes the scene and its pictures; returns the scene's path."""
    y, x = np.mgrid[-1:1:6j, -1:1:8j]
    for name, width in (("front", 1.0), ("side", 0.4)):
        np.save(
            folder / f"{name}.npy",
            (np.maximum(0.5 - x**2 / width - y**2, 0)[..., None] * np.ones(3)).astype(np.float32),
        )
    path = folder / "scene.yaml"
    path.write_text(SCENE)
    return path
