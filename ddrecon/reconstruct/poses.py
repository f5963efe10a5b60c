"""Poses of cameras, found by Gauss and Newton's steps from where a calibration put them (E29).

Descent along a derivative, each entry at its own rate, wanders where pictures say little: a turn
about the volume hardly moves an image, and a volume learns what is wrong with its cameras.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.cameras import Camera
from ddrecon.grid import Grid
from ddrecon.losses import Target
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.renderer import LightField, view_picture
from ddrecon.scene import Scene
from ddrecon.variables.default_rates import PIXELS
from ddrecon.variables.values import value_of, with_values

TURN = math.radians(1.0)
"""How far a calibration's direction of a camera may be off [rad],"""
SHIFT = 0.005
"""and its place, as a part of its distance from the volume."""
TRUST = 0.5
"""Pixels by which a volume may be off that was made with such cameras: pictures count against the
calibration as if each image were known no better.
"""
PART = 0.5
"""How far a step goes of the way,"""
LARGEST_STEP = 1.0
"""and at most, in pixels."""


def pose_curvature(light_field: LightField, scene: Scene, name: str, target: Target) -> Tensor:
    """The second derivative [6, 6] of the loss by the twist `name` (`views.NAME.camera`).

    It is that of Gauss and Newton, 2 J^T W J over the count of numbers, J being the derivative of
    the picture in the light of `light_field` and W the weights of the loss. `scene` has the values
    that the light is of.
    """
    view_name = name.removeprefix("views.").removesuffix(".camera")
    nothing, columns = value_of(scene, name), []
    for change in torch.eye(6, dtype=nothing.dtype, device=nothing.device):
        with torch.no_grad(), forward_ad.dual_level():
            moved = with_values(scene, {name: forward_ad.make_dual(nothing, change)})
            picture = view_picture(light_field, moved, moved.view(view_name))
            columns.append(forward_ad.unpack_dual(picture).tangent.clone())
    weighted = torch.stack(columns) * target.slope
    if target.seen is not None:
        weighted = weighted * target.seen
    matrix = weighted.flatten(1)
    return 2 * (matrix @ matrix.T) / target.count


def step_pose(parameter: Parameter, gradient: Tensor, curvature: Tensor, held: Tensor) -> None:
    """Takes the twist `parameter` part of the way to the least of its loss and its calibration.

    `gradient` [6] and `curvature` [6, 6] are of the loss of its view; `held` [6, 6] is how its
    calibration counts against that, of `weigh_calibration`.
    """
    unit = pixel_units(parameter)
    value, loss_slope = parameter.value.detach().double() / unit, gradient.double() * unit
    bent, held = (matrix.double() * unit * unit[:, None] for matrix in (curvature, held))
    tiny = torch.finfo(torch.float32).tiny
    both = bent + held + tiny * torch.eye(6).to(bent)
    step = torch.linalg.solve(both, loss_slope + held @ value)
    step = PART * step * (LARGEST_STEP / step.abs().max().clamp(min=LARGEST_STEP))
    moved = ((value - step) * unit).to(parameter.value)
    parameter.value = moved.clamp(parameter.low, parameter.high).requires_grad_()


def weigh_calibration(
    parameter: Parameter, curvature: Tensor, camera: Camera, grid: Grid
) -> Tensor:
    """The second derivative [6, 6] of what the calibration of `camera` adds to its view's loss.

    It is as strong as what the picture, by the loss's `curvature` [6, 6], says of a shift in the
    image by `TRUST`; `parameter` is the twist of the camera.
    """
    of_shifts = (curvature.diagonal().double() * pixel_units(parameter) ** 2)[3:5].mean()
    return calibration_prior(camera, grid) * (TRUST**2 * of_shifts)


def pixel_units(parameter: Parameter) -> Tensor:
    """What moves the image by a pixel, of each entry of a twist."""
    return torch.as_tensor(parameter.rate).double() / PIXELS


def calibration_prior(camera: Camera, grid: Grid) -> Tensor:
    """The inverse covariance [6, 6] of a twist of `camera` where its calibration is off (E29).

    The direction errs by `TURN`, and by itself: a camera turns about its own place, not about the
    volume as a twist does. The place errs by `SHIFT` of the distance from the middle of `grid`.
    """
    pose = camera.pose.detach().double()
    away = pose[:, :3].T @ (pose[:, 3] - pose.new_tensor(grid.center_xyz))
    distance = float(away.norm())
    if not camera.is_perspective:
        # Parallel rays come from no place: only what is across them counts.
        away, distance = torch.zeros_like(away), math.hypot(*grid.extent) / 2
    x, y, z = away.tolist()
    # Where the camera goes, in its own axes: turn x away + shift.
    turned = pose.new_tensor([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    place = torch.cat([turned, torch.eye(3).to(pose)], 1) / (SHIFT * distance)
    turn = torch.cat([torch.eye(3).to(pose), torch.zeros(3, 3).to(pose)], 1) / TURN
    return place.T @ place + turn.T @ turn
