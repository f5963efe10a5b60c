"""Whether a camera sees the volume at all."""

from __future__ import annotations

import math

import torch

from ddrecon.cameras import Camera, cast_rays
from ddrecon.grid import Grid
from ddrecon.march.box import cross_box

COARSER = 8
MOST_PIXELS = 2**18
"""Images are made about this small before they are looked at closely."""


def sees_box(camera: Camera, grid: Grid) -> bool:
    """Whether any pixel of `camera` looks through the box of `grid`; a coarser image is tried
    first, because it is quick.
    """
    finer = max(1, math.ceil(math.sqrt(camera.size[0] * camera.size[1] / MOST_PIXELS)))
    return any(
        cross_box(grid, cast_rays(image)).hit.numel() > 0
        for image in (camera.resize(COARSER * finer), camera.resize(finer))
    )


def explain_blindness(camera: Camera, grid: Grid) -> str:
    """Why, most likely, `camera` does not see the box of `grid`."""
    (low, high), pose = grid.bounds_xyz, camera.pose.double()
    center = (pose.new_tensor(low) + pose.new_tensor(high)) / 2
    if torch.dot(center - pose[:, 3], -pose[:, 2]) < 0:
        return (
            "the volume lies behind the camera, which looks along its -z axis with +y up, as in"
            " OpenGL: where poses are in OpenCV's axes, negate the second and third column of each"
            " matrix"
        )
    away = torch.dist(center, pose[:, 3]) / torch.dist(pose.new_tensor(low), pose.new_tensor(high))
    return (
        f"the camera looks past it, from {away:.3g} diagonals of the box away: check volume.bounds"
        " (are they in the units of the cameras?), its target, and its field of view or width"
    )
