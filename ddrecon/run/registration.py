"""Views held out, registered: what they would show by a camera that is where it seems to be.

A held-out camera may err as all do, and then says more of itself than of the volume. So its pose
and exposure are fitted to the finished volume, by Gauss and Newton with the slopes of where it was
given, by differences: shifts are small. The volume stays as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Camera, project
from ddrecon.light_field import LightField
from ddrecon.losses import Target
from ddrecon.medium.coefficients import Volume
from ddrecon.picture import view_picture
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.objective import fit_held_out
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import pose_change
from ddrecon.variables.values import extinction_of, with_values

STEPS = 8
"""The most steps; they end when one improves nothing."""
DAMPING = 1e-3
"""Curvature added to all, as a part of the largest: what a picture does not show stays."""
LARGEST_STEP = 40.0
"""No step is farther than so many rates, of a quarter of a pixel."""


def register(
    light_field: LightField, scene: Scene, view: View, target: Target, sizes: Mapping[str, int]
) -> dict[str, Any]:
    """PSNR [dB] and SSIM of `view` registered to the volume of `scene`, lit by `light_field`.

    And by how many pixels its smoke moved. `sizes` are as for `fit_held_out`.
    """
    name = f"views.{view.name}.camera"
    unit = pose_change(scene, name, view.camera.pose)

    def see_by(change: Tensor) -> tuple[View, Tensor]:
        world = with_values(scene, {name: change})
        moved = world.view(view.name)
        return moved, view_picture(light_field, world, moved)

    change, sizes, best = torch.zeros_like(unit), {"exposure": 1, **sizes}, dict[str, Any]()
    moved, picture = see_by(change)
    camera = moved.camera
    offsets = (tuning.APART * unit).diag()
    changes = torch.stack([see_by(offset)[1] - picture for offset in offsets]) / tuning.APART
    for _ in range(STEPS):
        fitted, response = fit_held_out(picture, view, target, sizes)
        psnr = float(target.psnr_of(fitted))
        if best and psnr <= best["psnr"]:
            break
        best, camera = {"psnr": psnr, "ssim": float(target.ssim_of(fitted))}, moved.camera
        # Errors are those that PSNR counts, of values as they are compared.
        exposure = 1.0 if view.exposure is None else view.exposure.view(-1, 1, 1)
        slope = target.on.slope(fitted) * response["exposure"].view(-1, 1, 1) / exposure
        error = target.compared - target.on.values(fitted)
        if target.seen is not None:
            slope, error = slope * target.seen, error * target.seen
        jacobian = (changes * slope).flatten(1).double().cpu()
        residual = error.flatten().double().cpu()
        matrix = jacobian @ jacobian.T
        matrix = matrix + DAMPING * matrix.diagonal().max() * torch.eye(6).double()
        step = torch.linalg.lstsq(matrix, jacobian @ residual).solution
        step = step / (step.abs().max() / LARGEST_STEP).clamp(min=1)
        change = change + step.to(unit) * unit
        moved, picture = see_by(change)
    return best | {"shift": shift_between(view.camera, camera, scene.volume)}


def shift_between(camera: Camera, other_camera: Camera, volume: Volume) -> float:
    """By how many pixels, in the mean, what is in `volume` moves in the image of `other_camera`.

    Cells count by their extinction, all alike where there is none.
    """
    weight = (extinction_of(volume).amax(0) * volume.density).flatten()
    weight = weight if bool(weight.any()) else torch.ones_like(weight)
    z, y, x = torch.broadcast_tensors(*volume.grid.centers(weight))
    centers = torch.stack([x, y, z], -1).flatten(0, 2)[weight > 0].to(camera.pose)
    (place, _), (moved, _) = (
        project(view_camera, centers) for view_camera in (camera, other_camera)
    )
    shift = (place - moved).norm(dim=1).to(weight)
    weight = weight[weight > 0] * shift.isfinite()
    return float((weight * shift).nansum() / weight.sum())
