"""The reconstruction of a run, and how good its pictures are, for its report and its summary.

A held-out camera may err as all do, and then says more of itself than of the volume. So views held
out are registered as well: their pose and exposure are fitted to the finished volume, by Gauss and
Newton with the slopes of where they were given, by differences: shifts are small.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import Camera, project
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.light_field import LightField
from ddrecon.lighting import solve_light
from ddrecon.losses import Target
from ddrecon.medium.coefficients import Volume
from ddrecon.picture import view_picture
from ddrecon.pictures.scales import COMPARED, LINEAR
from ddrecon.progress import Progress
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.objective import fit_held_out, response_sizes
from ddrecon.reconstruct.setup import choose_loss, targets_of
from ddrecon.scene import Scene, View
from ddrecon.settings import OptimizeSettings
from ddrecon.variables.kinds import is_of_volume, pose_change
from ddrecon.variables.values import extinction_of, value_of, with_values

STEPS = 8
"""The most steps; they end when one improves nothing."""
DAMPING = 1e-3
"""Curvature added to all, as a part of the largest: what a picture does not show stays."""
LARGEST_STEP = 40.0
"""No step is farther than so many rates, of a quarter of a pixel."""


@dataclass(frozen=True)
class Findings:
    """The reconstructed `scene`, and the image and `quality` of each view with a target.

    `quality[view]` holds `split`, `psnr`, `ssim`; test views also have `fitted_exposure` or
    `fitted_offset`, and `registered`. `truths` maps a field's name to the scene file's values where
    the run started from others: usually the ground truth.
    """

    scene: Scene
    truths: Mapping[str, Tensor]
    images: Mapping[str, Tensor]
    quality: Mapping[str, Mapping[str, Any]]


def find_results(run: Reconstruction, progress: Progress | None = None) -> Findings:
    """The current result of `run`, rendered; with a `progress`, held-out views are registered."""
    scene = run.current_scene()
    shown = [view for view in scene.views if view.image is not None]
    targets = targets_of(replace(scene, views=shown), run.problem.loss, run.problem.noises)
    images, quality = dict[str, Tensor](), dict[str, dict[str, Any]]()
    with torch.no_grad():
        light_field = solve_light(scene, SolveMemory())
        for view in shown:
            target, sizes = targets[view.name], response_sizes(run.parameters)
            fitted = dict[str, Tensor]()
            picture = view_picture(light_field, scene, view)
            if view.is_test:
                picture, fitted = fit_held_out(picture, view, target, sizes)
            images[view.name] = picture
            quality[view.name] = {
                "split": "test" if view.is_test else "train",
                "psnr": float(target.psnr_of(picture)),
                "ssim": float(target.ssim_of(picture)),
                **{f"fitted_{key}": value.tolist() for key, value in fitted.items()},
            }
        held_out = [view for view in shown if view.is_test]
        for view in progress(held_out, "register") if progress and held_out else ():
            target = targets[view.name]
            registered = register(light_field, scene, view, target, response_sizes(run.parameters))
            quality[view.name]["registered"] = registered
    return Findings(scene, _find_truths(run.problem.scene), images, quality)


def _find_truths(scene: Scene) -> dict[str, Tensor]:
    """The optimized fields of `scene` that start from other values: the truth, perhaps.

    Fields that are the same in every cell are left out.
    """
    truths = {}
    for name, start in scene.starts.items():
        if is_of_volume(name) and (value := value_of(scene, name)).ndim >= 3:
            is_start = start.shape == value.shape and torch.equal(start, value)
            if not is_start and bool((value != value.flatten()[0]).any()):
                truths[name] = value
    return truths


def describe_loss(settings: OptimizeSettings, train: Scene) -> dict[str, Any]:
    """The loss that fits the views of `train` by `settings`, and what it compares.

    Raises SceneError where pictures of different kinds leave it open.
    """
    loss = choose_loss(settings, train)
    return {"loss_function": loss, "compared": COMPARED.get(loss, LINEAR)}


def loss_text(described: Mapping[str, Any]) -> str:
    """What `describe_loss` says, as a line."""
    return f"loss: {described['loss_function']}, of {described['compared']}"


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
