"""Which picture to take next: the candidate farthest from the existing cameras.

A ranking by the variance that a picture would remove proposed worse ones (docs/decisions.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Camera
from ddrecon.scene import Scene
from ddrecon.turntable import place_turntable

CANDIDATES = 12
"""Cameras that are ranked."""
TIED = 2 / 3
"""Candidates of at least this part of the best angle were as good where it was tried."""


def rank_views(scene: Scene) -> list[dict[str, Any]]:
    """The candidates of `uncertainty.json` for the next picture of `scene`, best first.

    All are its first camera, turned around the volume. Each has its `name`; `angle` [degrees] to
    the nearest existing camera; `matrix` [4, 4], camera to world; and whether it `is_tied` with the
    best.
    """
    existing = [_way_to(view.camera, scene) for view in scene.views]
    ranked = list[dict[str, Any]]()
    for view in place_turntable(scene, scene.views[0], CANDIDATES):
        angle = _nearest(_way_to(view.camera, scene), existing)
        matrix = [*view.camera.pose.tolist(), [0, 0, 0, 1]]
        ranked.append({"name": view.name, "angle": angle, "matrix": matrix})
    ranked.sort(key=lambda candidate: -candidate["angle"])
    for candidate in ranked:
        candidate["is_tied"] = candidate["angle"] >= TIED * ranked[0]["angle"]
    return ranked


def _way_to(camera: Camera, scene: Scene) -> Tensor:
    """Where `camera` is, as seen from the middle of the volume of `scene`."""
    if not camera.is_perspective:
        return camera.pose[:, 2]
    return camera.pose[:, 3] - camera.pose.new_tensor(scene.volume.grid.center_xyz)


def _nearest(direction: Tensor, directions: Sequence[Tensor]) -> float:
    """The angle [degrees] between `direction` and the nearest of `directions`."""
    cosines = torch.stack(
        [torch.cosine_similarity(direction, other_direction, 0) for other_direction in directions]
    )
    return math.degrees(math.acos(min(float(cosines.max()), 1.0)))
