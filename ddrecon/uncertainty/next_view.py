"""Which picture to take next: the one from farthest off those that there are.

How much of what experiments leave open a picture would tell was tried, and proposed worse pictures
(docs/decisions.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Camera
from ddrecon.errors import UsageError
from ddrecon.light.lights import DirectionalLight
from ddrecon.scene import Scene
from ddrecon.turntable import place_turntable

CANDIDATES = 12
"""Pictures that are ranked."""
TIED = 2 / 3
"""So far off as a part of the best, a picture was as good where it was tried."""


def rank_views(scene: Scene, kind: str) -> list[dict[str, Any]]:
    """What `uncertainty.json` says of pictures that `scene` may get, best first.

    All are by its first camera: `ring`: it is turned around the volume; `lights`: the directional
    lights are. Of each: `name`; `angle` [degrees], how far off the nearest picture it looks from,
    or the nearest light shines; `matrix` [4, 4], camera to world; `light_directions` [n, 3]; and
    whether it `is_tied` with the best. Raises UsageError for lights where there are none.
    """
    first, ranked = scene.views[0], list[dict[str, Any]]()
    suns = [light.direction for light in scene.lights if isinstance(light, DirectionalLight)]
    if kind == "lights" and not suns:
        raise UsageError("--next-view lights turns directional lights; the scene has none")
    taken = [_way_to(view.camera, scene) for view in scene.views]
    for index, view in enumerate(place_turntable(scene, first, CANDIDATES)):
        if kind == "ring":
            name, camera, ways = view.name, view.camera, list[Tensor]()
            angle = _nearest(_way_to(camera, scene), taken)
        else:
            turn = view.camera.pose[:, :3] @ first.camera.pose[:, :3].T
            name, camera, ways = f"light_{index:03d}", first.camera, [turn @ way for way in suns]
            angle = min(_nearest(way, suns) for way in ways)
        matrix = [*camera.pose.tolist(), [0, 0, 0, 1]]
        found = {"name": name, "angle": angle, "matrix": matrix}
        ranked.append(found | {"light_directions": [way.tolist() for way in ways]})
    ranked.sort(key=lambda each: -each["angle"])
    for each in ranked:
        each["is_tied"] = each["angle"] >= TIED * ranked[0]["angle"]
    return ranked


def _way_to(camera: Camera, scene: Scene) -> Tensor:
    """Where `camera` is, as seen from the middle of the volume of `scene`."""
    if not camera.is_perspective:
        return camera.pose[:, 2]
    return camera.pose[:, 3] - camera.pose.new_tensor(scene.volume.grid.center_xyz)


def _nearest(way: Tensor, others: Sequence[Tensor]) -> float:
    """The angle [degrees] between `way` and the nearest of the `others`."""
    cosines = torch.stack([torch.cosine_similarity(way, other, 0) for other in others])
    return math.degrees(math.acos(min(float(cosines.max()), 1.0)))
