"""Cameras around a volume, turned about the upright axis through the box's middle."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from ddrecon.cameras import Camera, rotation
from ddrecon.grid import Triple
from ddrecon.scene import Scene, View


def upright_axis(scene: Scene) -> int:
    """Which of x, y, z (0, 1, 2) points up in `scene`.

    A scene that does not say has the one nearest to the sum of its cameras' up vectors.
    """
    if scene.up is not None:
        return scene.up
    upward = torch.stack([view.camera.pose[:, 1] for view in scene.views])
    return int(upward.sum(0).abs().argmax())


def turn_camera(camera: Camera, axis: int, angle: float, center: Triple) -> Camera:
    """`camera` turned by `angle` [rad] about the `axis` (0, 1, 2: x, y, z) through `center`."""
    middle = camera.pose.new_tensor(center)
    turn = rotation(angle * torch.eye(3, dtype=torch.float64)[axis]).to(camera.pose)
    origin = middle + turn @ (camera.pose[:, 3] - middle)
    return replace(camera, pose=torch.cat([turn @ camera.pose[:, :3], origin[:, None]], 1))


def place_turntable(scene: Scene, view: View, count: int) -> list[View]:
    """`count` >= 1 views, from `view` in equal steps once around the volume of `scene`.

    They are called `ring_000`, which is that of `view`, `ring_001` and so on.
    """
    axis, center = upright_axis(scene), scene.volume.grid.center_xyz
    angles = (2 * math.pi * number / count for number in range(count))
    cameras = (turn_camera(view.camera, axis, angle, center) for angle in angles)
    return [View(f"ring_{number:03d}", camera) for number, camera in enumerate(cameras)]
