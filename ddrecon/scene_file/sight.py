"""Whether a camera sees the volume at all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

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


def _turn_axes(pose: Tensor) -> Tensor:
    """`pose` [3, 4] with OpenCV's axes for OpenGL's, or the other way round."""
    return pose * pose.new_tensor([1, -1, -1, 1])


def _invert(pose: Tensor) -> Tensor:
    """World to camera for camera to world, of a rigid `pose` [3, 4]."""
    rotation = pose[:, :3].T
    return torch.cat([rotation, -rotation @ pose[:, 3:]], 1)


CURES = {
    "the matrices are in OpenCV's axes (y down, z forward), ours in OpenGL's: negate the second and"
    " third column of each": _turn_axes,
    "the matrices are world to camera, ours camera to world: invert each": _invert,
    "the matrices are world to camera in OpenCV's axes, as COLMAP has them, ours camera to world in"
    " OpenGL's: invert each, then negate its second and third column": lambda pose: _turn_axes(
        _invert(pose)
    ),
}
"""What may be wrong with matrices, and what is right then."""


def explain_blindness(blind: Sequence[Camera], others: Sequence[Camera], grid: Grid) -> str:
    """Why, most likely, the cameras `blind` do not see the box of `grid`.

    All of them, and `others`, which do see it, have their poses as matrices. Where none have, there
    are no `others`, and a wrong target is the likely cause.
    """
    for cameras in ([*blind, *others], blind):
        misses = {what: _mean_miss(cameras, cure, grid) for what, cure in CURES.items()}
        what = min(misses, key=misses.__getitem__)
        if math.isfinite(misses[what]):
            return what
    return explain_direction(blind, grid)


def _mean_miss(cameras: Sequence[Camera], cure: Callable[[Tensor], Tensor], grid: Grid) -> float:
    """How far the `cameras`, cured, look past the middle of the box, on average [rad].

    Infinite where one of them does not see it.
    """
    angles = []
    for camera in cameras:
        cured = replace(camera, pose=cure(camera.pose.double()))
        if not sees_box(cured, grid):
            return math.inf
        angles.append(_angle_off(cured.pose, grid))
    return sum(angles) / len(angles)


def _angle_off(pose: Tensor, grid: Grid) -> float:
    """The angle between where a camera looks and where the middle of the box is [rad]."""
    towards = pose.new_tensor(grid.center_xyz) - pose[:, 3]
    cosine = torch.dot(towards, -pose[:, 2]) / towards.norm().clamp(min=1e-30)
    return math.acos(max(-1.0, min(1.0, float(cosine))))


def explain_direction(cameras: Sequence[Camera], grid: Grid) -> str:
    """Where `cameras` look instead of at the box of `grid`."""
    poses = [camera.pose.double() for camera in cameras]
    if all(_angle_off(pose, grid) > math.pi / 2 for pose in poses):
        return "the volume lies behind: a camera looks along its -z axis with +y up, as in OpenGL"
    low, high = (poses[0].new_tensor(corner) for corner in grid.bounds_xyz)
    away = min(float(torch.dist((low + high) / 2, pose[:, 3])) for pose in poses)
    return (
        f"it is looked past, from {away / float(torch.dist(low, high)):.3g} diagonals of the box"
        " away: check volume.bounds (are they in the units of the cameras?), targets, and fields of"
        " view or widths"
    )
