"""Gauges: changes of several parameters together that no picture shows, and that are not made.

Twice the exposure of all cameras is half the light; all cameras moved together move the volume.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import Scene, View


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
