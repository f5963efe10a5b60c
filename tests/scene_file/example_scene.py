"""A small legal scene to break in one place at a time."""

from typing import Any

import numpy as np
import yaml

from ddrecon.scene_file.load import scene_text

CAMERA = (
    "{type: perspective, origin: [0, 0.3, 3.2], target: [0, 0, 0], fov: 28, resolution: [8, 6]}"
)
SCENE = f"""\
volume:
  bounds: {{min: [-0.5, -0.75, -0.5], max: [0.5, 0.75, 0.5]}}
  resolution: [2, 3, 4]
  density: {{constant: 0.1}}
  sigma_a: 0.6
  sigma_s: [11.4, 10.8, 9.6]
  g: 0.3
lights:
  - {{type: directional, direction: [-2, -2, -1], irradiance: 3.14159}}
  - {{type: ambient, radiance: [0.2, 0.3, 0.5]}}
views:
  - {{name: front, camera: {CAMERA}}}
"""
TREE = yaml.safe_load(SCENE)
VOLUME, VIEW = TREE["volume"], TREE["views"][0]
BOUNDS = np.array([[-0.5, -0.75, -0.5], [0.5, 0.75, 0.5]])
SHAPE = (4, 3, 2)
"""Its cells [z, y, x]."""


def changed(**sections: Any) -> str:
    """`SCENE` with whole sections replaced, or, where the value is None, left out."""
    tree = TREE | sections
    return scene_text({name: value for name, value in tree.items() if value is not None})


def volume(left_out: tuple[str, ...] = (), views: Any = TREE["views"], **changes: Any) -> str:
    """`SCENE` with another volume, or other views as well."""
    section = {name: value for name, value in (VOLUME | changes).items() if name not in left_out}
    return changed(volume=section, views=views)
