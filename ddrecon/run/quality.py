"""The reconstruction of a run, and how good its pictures are, for its report and its summary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.lighting import solve_light
from ddrecon.picture import view_picture
from ddrecon.pictures.scales import COMPARED, LINEAR
from ddrecon.progress import Progress
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.objective import fit_held_out, response_sizes
from ddrecon.reconstruct.setup import choose_loss, targets_of
from ddrecon.run.registration import register
from ddrecon.scene import Scene
from ddrecon.settings import OptimizeSettings
from ddrecon.variables.kinds import is_of_volume
from ddrecon.variables.values import value_of


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
