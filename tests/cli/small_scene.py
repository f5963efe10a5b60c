"""A small legal scene without transport rounds, which take long; and what is in a folder."""

from pathlib import Path

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
