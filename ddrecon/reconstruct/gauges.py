"""What is known of numbers without pictures: gauges, and how calibrations err.

A gauge is a change of several parameters together that no picture shows, and that is not made.

Twice the exposure of all cameras is half the light; all cameras moved together move the volume.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.cameras import Camera
from ddrecon.grid import Grid
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import Scene, View
from ddrecon.variables.default_rates import PIXELS


@dataclass
class Gauge:
    """`parameters` whose changes from `start` [n] have no part in `directions` [n, k].

    The directions are orthonormal, of all entries one after another. With `is_relative`, changes
    are those of logarithms.
    """

    parameters: Sequence[Parameter]
    start: Tensor
    directions: Tensor
    is_relative: bool

    @staticmethod
    def of(parameters: Sequence[Parameter], directions: Tensor, is_relative: bool) -> Gauge:
        """The gauge that `directions`, not yet orthonormal, span about the values as they are."""
        gauge = Gauge(parameters, directions[:, 0], torch.linalg.qr(directions)[0], is_relative)
        gauge.start = gauge._values()
        return gauge

    def hold(self) -> None:
        """Takes the part of the directions out of the parameters' values."""
        values = self._values()
        values = values - self.directions @ (self.directions.T @ (values - self.start))
        values = values.exp() if self.is_relative else values
        sizes = [parameter.value.numel() for parameter in self.parameters]
        for parameter, value in zip(self.parameters, values.split(sizes), strict=True):
            held = value.view(parameter.value.shape).clamp(parameter.low, parameter.high)
            parameter.value = held.requires_grad_()

    def _values(self) -> Tensor:
        values = torch.cat([parameter.value.detach().flatten() for parameter in self.parameters])
        return values.log() if self.is_relative else values


def find_gauges(train: Scene, parameters: Sequence[Parameter]) -> list[Gauge]:
    """The gauges of `parameters`, where those of every training view of several are among them."""
    known = {parameter.name: parameter for parameter in parameters}
    gauges, views = list[Gauge](), train.views

    def of_all(key: str) -> list[Parameter]:
        chosen = [known.get(f"views.{view.name}.{key}") for view in views]
        found = [parameter for parameter in chosen if parameter is not None]
        return found if len(found) == len(views) > 1 else []

    if exposures := of_all("exposure"):
        gauges.append(Gauge.of(exposures, _common_gain(exposures), is_relative=True))
    if cameras := of_all("camera"):
        directions = torch.cat([_common_motion(view, train) for view in views])
        gauges.append(Gauge.of(cameras, directions, is_relative=False))
    return gauges


def _common_gain(exposures: Sequence[Parameter]) -> Tensor:
    """The same gain of all, [n, C]: of each color by itself where all have three."""
    like = exposures[0].value.detach()
    if all(len(parameter.value) == len(like) for parameter in exposures):
        return torch.eye(len(like), dtype=like.dtype, device=like.device).repeat(len(exposures), 1)
    return like.new_ones(sum(len(parameter.value) for parameter in exposures), 1)


def _common_motion(view: View, scene: Scene) -> Tensor:
    """What the volume's turns, shifts and growth are in the twist of a `view`, [6, 7].

    A twist is in the camera's own axes (E29). A volume that grows looks as if it came closer.
    """
    axes, origin = view.camera.pose[:, :3].detach(), view.camera.pose[:, 3].detach()
    motion = axes.new_zeros(6, 7)
    motion[:3, :3] = motion[3:, 3:6] = axes.T
    away = origin - origin.new_tensor(scene.volume.grid.center_xyz)
    if view.camera.is_perspective:
        motion[3:, 6] = axes.T @ away
    return motion


def weigh_calibration(pose: Parameter, curvature: Tensor, unit: Tensor, scene: Scene) -> Tensor:
    """The second derivative [6, 6] of what the calibration of a camera adds to its view's loss.

    It is as strong as what the picture, by the loss's `curvature` [6, 6], says of a shift in the
    image by `TRUST`; both are in the `unit` [6] of the twist `pose`, its rates.
    """
    assert pose.view is not None
    of_shifts = curvature.diagonal()[3:5].mean() / PIXELS**2
    prior = calibration_prior(scene.view(pose.view).camera, scene.volume.grid).cpu()
    return prior * unit * unit[:, None] * (tuning.TRUST**2 * of_shifts)


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
    place = torch.cat([turned, torch.eye(3).to(pose)], 1) / (tuning.SHIFT * distance)
    turn = torch.cat([torch.eye(3).to(pose), torch.zeros(3, 3).to(pose)], 1) / tuning.TURN
    return place.T @ place + turn.T @ turn
