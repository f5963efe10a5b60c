"""Whether a camera sees the volume at all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ddrecon.cameras import Camera, cast_rays, project
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


CONVENTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "OpenCV axes (right, down, forward): negate the second and third column of each matrix": (
        lambda pose: pose * pose.new_tensor([1, -1, -1, 1])
    ),
    "world to camera: give the inverse of each matrix": lambda pose: _inverse(pose),
    "world to camera with OpenCV axes: give the inverse of each matrix, its second and third column"
    " negated": lambda pose: _inverse(pose) * pose.new_tensor([1, -1, -1, 1]),
    "z up, as in Blender, in a scene with y up: turn the cameras or volume.bounds": (
        lambda pose: pose.new_tensor([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ pose
    ),
    "y up in a scene with z up, as in Blender: turn the cameras or volume.bounds": (
        lambda pose: pose.new_tensor([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ pose
    ),
}
"""What poses may be instead of camera to world with OpenGL axes, and what makes these of them."""


def explain_blindness(cameras: Sequence[Camera], grid: Grid, seeing: Sequence[Camera] = ()) -> str:
    """Why, most likely, none of `cameras` sees the box of `grid`.

    `seeing` are those of the scene that do, which they may by chance.
    """
    middle = grid.center_xyz
    if all(_looks_at(camera, grid) for camera in cameras):
        return (
            "it is in the picture, but smaller than a pixel: are volume.bounds and the cameras in"
            " the same unit?"
        )
    for group in ([*cameras, *seeing], cameras):
        for what, convert in CONVENTIONS.items() if len(group) > 1 else ():
            if all(_looks_at(replace(one, pose=convert(one.pose)), grid) for one in group):
                return f"it would with matrices read otherwise; they seem to be {what}"
    if len(cameras) > 1 and (place := _meeting_place(cameras)) is not None:
        return (
            f"the cameras look at about ({', '.join(f'{x:.3g}' for x in place.tolist())}), but the"
            f" middle of volume.bounds is ({', '.join(f'{x:.3g}' for x in middle)}): are both in"
            " the same units and axes?"
        )
    (low, high), pose = grid.bounds_xyz, cameras[0].pose.double()
    center = pose.new_tensor(middle)
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


def _inverse(pose: Tensor) -> Tensor:
    turned = pose[:, :3].T
    return torch.cat([turned, -turned @ pose[:, 3:]], 1)


def _looks_at(camera: Camera, grid: Grid) -> bool:
    """Whether the middle of the box of `grid` is in the image of `camera`."""
    center = camera.pose.new_tensor([grid.center_xyz])
    (column, row), _ = (values[0] for values in project(camera, center))
    height, width = camera.size
    return bool((column >= 0) & (column <= width) & (row >= 0) & (row <= height))


def _meeting_place(cameras: Sequence[Camera]) -> Tensor | None:
    """The point (x, y, z) nearest to the axes of `cameras`; None where they are parallel."""
    poses = torch.stack([camera.pose.double() for camera in cameras])
    axes, origins = poses[:, :, 2:3], poses[:, :, 3:]
    across = torch.eye(3, dtype=poses.dtype) - axes @ axes.mT
    total = across.sum(0)
    if torch.linalg.eigvalsh(total)[0] < 1e-3 * len(cameras):
        return None
    return torch.linalg.solve(total, (across @ origins).sum(0))[:, 0]
