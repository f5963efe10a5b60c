"""A small legal scene without transport rounds, which take long; and what is in a folder."""

from pathlib import Path

import numpy as np

from ddrecon.io.volumes.table import write_field

SCENE = """\
volume:
  bounds: {min: [-0.5, -0.5, -0.5], max: [0.5, 0.5, 0.5]}
  resolution: [6, 5, 4]
  density: 0.2
  sigma_a: 0.5
  sigma_s: [6, 5, 4]
  g: 0.3
lights:
  - {type: directional, direction: [-1, -2, -1], irradiance: 3}
  - {type: ambient, radiance: 0.1}
views:
  - {name: front, image: front.npy, camera: {type: perspective, fov: 30,
     origin: [0, 0, 2.5], target: [0, 0, 0], resolution: [8, 6]}}
  - {name: side, image: side.npy, split: test,
     camera: {type: perspective, fov: 30,
     origin: [2.5, 0, 0], target: [0, 0, 0], resolution: [8, 6]}}
diffusion: {transport_rounds: 0}
optimize:
  iterations: 4
  parameters: {density: {init: 0}}
"""


def contents(folder: Path) -> dict[str, bytes | None]:
    """Every file and folder below `folder`, by path."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


def write_scene(folder: Path) -> Path:
    """Writes the scene, its images front.npy and side.npy, and density.npz; its path."""
    y, x = np.mgrid[-1:1:6j, -1:1:8j]
    picture = np.maximum(0.5 - x**2 - y**2, 0.1)[..., None] * [1.0, 0.8, 0.6]
    for name in ("front", "side"):
        np.save(folder / f"{name}.npy", picture.astype(np.float32))
    values = np.random.default_rng(0).random((4, 5, 6))
    write_field(folder / "density.npz", "density", values, np.array([[-0.5] * 3, [0.5] * 3]))
    path = folder / "scene.yaml"
    path.write_text(SCENE)
    return path
