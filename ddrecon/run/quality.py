"""What a run has found, and how good its pictures are, for its report, its page and its summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.pictures.scales import COMPARED, LINEAR
from ddrecon.reconstruct.log import Row
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.responses import fit_held_out
from ddrecon.reconstruct.setup import choose_loss, targets_of
from ddrecon.renderer import LightField, solve_light, view_picture
from ddrecon.scene import Scene
from ddrecon.settings import OptimizeSettings
from ddrecon.variables.values import value_of


@dataclass(frozen=True)
class Findings:
    """The `scene` as found, `images` and quality by view, and the log.

    `given` are the fields of the scene file in whose place others were found, by name.
    """

    scene: Scene
    given: Mapping[str, Tensor]
    light_field: LightField
    images: Mapping[str, Tensor]
    quality: Mapping[str, Mapping[str, Any]]
    rows: Sequence[Row]
    summary: Mapping[str, Any]
    environment: Mapping[str, Any]
    settings: str


def given_fields(scene: Scene) -> dict[str, Tensor]:
    """The fields of `scene` that are optimized but start from something else: the truth, perhaps.

    What is the same in every cell is not told.
    """
    given = {}
    for name, start in scene.starts.items():
        if name.startswith(("lights.", "views.")):
            continue
        value = value_of(scene, name)
        if value.ndim >= 3 and bool((value != value.flatten()[0]).any()):
            is_start = start.shape == value.shape and torch.equal(start, value)
            if not is_start:
                given[name] = value
    return given


def solve(scene: Scene) -> LightField:
    """The light in `scene`, without derivatives."""
    with torch.no_grad():
        return solve_light(scene, SolveMemory())


def render_views(
    run: Reconstruction, scene: Scene, light_field: LightField
) -> tuple[dict[str, Tensor], dict[str, dict[str, Any]]]:
    """The picture of each view of `scene` that has a target, by name, and its quality.

    That is its split, PSNR and SSIM, and of a test view the exposure it was given to compare it.
    """
    shown = [view for view in scene.views if view.image is not None]
    targets = targets_of(replace(scene, views=shown), run.problem.loss, run.problem.noises)
    pictures, quality = {}, {}
    for view in shown:
        target, fitted = targets[view.name], dict[str, Tensor]()
        with torch.no_grad():
            picture = view_picture(light_field, scene, view)
            if view.is_test:
                picture, fitted = fit_held_out(picture, view, target, run.parameters)
        pictures[view.name] = picture
        quality[view.name] = {
            "split": "test" if view.is_test else "train",
            "psnr": float(target.psnr_of(picture)),
            "ssim": float(target.ssim_of(picture)),
            **{f"fitted_{key}": value.tolist() for key, value in fitted.items()},
        }
    return pictures, quality


def render_run(
    run: Reconstruction,
) -> tuple[Scene, LightField, dict[str, Tensor], dict[str, dict[str, Any]]]:
    """The scene that `run` has found, the light in it, and what `render_views` makes of both."""
    scene = run.current_scene()
    light_field = solve(scene)
    return scene, light_field, *render_views(run, scene, light_field)


def compared_by(run: Reconstruction) -> dict[str, Any]:
    """What `run` minimizes and what its pictures are compared in, for its summary."""
    described = describe_loss(run.problem.settings, run.problem.train)
    if run.problem.loss == "photon":
        described["noise"] = {name: vars(noise) for name, noise in run.problem.noises.items()}
    return described


def describe_loss(settings: OptimizeSettings, train: Scene) -> dict[str, Any]:
    """The loss that fits the views of `train` by `settings`, and what it compares.

    Raises SceneError where pictures of different kinds leave it open.
    """
    loss = choose_loss(settings, train)
    return {"loss_function": loss, "compared": COMPARED.get(loss, LINEAR)}


def loss_text(described: Mapping[str, Any]) -> str:
    """What `describe_loss` says, as a line."""
    return f"loss: {described['loss_function']}, of {described['compared']}"
