"""The reconstruction of a run, how good its pictures are, and what seems to be wrong with it.

A held-out camera may err as all do, and then says more of itself than of the volume. So views held
out are registered as well: their pose and exposure are fitted to the finished volume, by Gauss and
Newton with the slopes of where they were given, by differences: shifts are small.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import mean, median
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
from ddrecon.pictures import COMPARED, LINEAR
from ddrecon.progress import show_progress
from ddrecon.reconstruct import tuning
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.reconstruct.objective import fit_held_out, response_sizes, target_of
from ddrecon.reconstruct.setup import choose_loss, targets_of
from ddrecon.reconstruct.support import Support, find_cut
from ddrecon.scene import Scene, View
from ddrecon.settings import OptimizeSettings
from ddrecon.terms import THINNEST
from ddrecon.variables.kinds import is_of_volume, pose_change
from ddrecon.variables.values import extinction_of, value_of, with_values

STEPS = 8
"""The most steps; they end when one improves nothing."""
DAMPING = 1e-3
"""Curvature added to all, as a part of the largest: what a picture does not show stays."""
LARGEST_STEP = 40.0
"""No step is farther than so many rates, of a quarter of a pixel."""
OVERFIT = 6.0
"""Held-out views this much worse than those trained on [dB] are not explained by noise."""
UNEXPLAINED = 4.0
"""Images this many times farther off than noise and the model's own error are of another scene."""
FACTOR = 1.15
"""A view whose brightness is off by this factor, against the others, was exposed differently."""
SHIFT = 0.5
"""A render that fits better when moved by more pixels was seen by another camera."""
EXPLAINED, MOVED = 0.3, 0.2
"""The parts of a residual that a factor and a move have to explain; a volume that was fitted to the
other views hides some of a move."""
WORTHWHILE = 0.1
"""A run is unfinished where its loss can fall by this part of it."""
MOST_NAMED = 4


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

    @property
    def seen(self) -> list[View]:
        """The views that have a target."""
        return [view for view in self.scene.views if view.image is not None]

    def means(self) -> dict[str, Any]:
        """Means over training views, over test views (`test_psnr`), and of `registered` ones.

        They are of whole pictures; those of iterations are of pixels as the run averages them.
        """
        means = dict[str, Any]()
        for split, prefix in (("train", ""), ("test", "test_")):
            rows = [row for row in self.quality.values() if row["split"] == split]
            if rows:
                means |= {f"{prefix}{k}": mean(row[k] for row in rows) for k in ("psnr", "ssim")}
        if seen := [row["registered"] for row in self.quality.values() if "registered" in row]:
            means["registered"] = {key: mean(row[key] for row in seen) for key in seen[0]}
        return means


def find_results(run: Reconstruction, is_last: bool = False) -> Findings:
    """The current result of `run`, rendered; if it `is_last`, held-out views are registered."""
    scene, sizes = run.current_scene(), response_sizes(run.parameters)
    images, quality = dict[str, Tensor](), dict[str, dict[str, Any]]()
    findings = Findings(scene, _find_truths(run.problem.scene), images, quality)
    compared = replace(scene, views=findings.seen)
    targets = targets_of(compared, run.problem.loss, run.problem.noises)
    with torch.no_grad():
        light_field = solve_light(scene, SolveMemory())
        for view in show_progress(compared.views, "register") if is_last else compared.views:
            target, fitted = targets[view.name], dict[str, Tensor]()
            picture = view_picture(light_field, scene, view)
            if view.is_test:
                picture, fitted = fit_held_out(picture, view, target, sizes)
            images[view.name] = picture
            row = quality[view.name] = {
                "split": "test" if view.is_test else "train",
                "psnr": float(target.psnr_of(picture)),
                "ssim": float(target.ssim_of(picture)),
                **{f"fitted_{key}": value.tolist() for key, value in fitted.items()},
            }
            if is_last and view.is_test:
                row["registered"] = register(light_field, scene, view, target, sizes)
    return findings


def _find_truths(scene: Scene) -> dict[str, Tensor]:
    """The optimized fields of `scene` that start from other values: the truth, perhaps.

    Fields that are the same in every cell are left out.
    """
    values = {name: value_of(scene, name) for name in scene.starts if is_of_volume(name)}
    return {
        name: value
        for name, value in values.items()
        if value.ndim >= 3
        and not torch.equal(value, scene.starts[name])
        and bool((value != value.flatten()[0]).any())
    }


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

    Cells count by their extinction, all alike where there is none. It is the image's diagonal where
    there is no cell that both cameras look at.
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
    is_seen = bool(weight.any())
    return float((weight * shift).nansum() / weight.sum()) if is_seen else math.hypot(*camera.size)


def diagnose(
    findings: Findings,
    iteration: int,
    gain: float,
    support: Support | None = None,
    doubt: str | None = None,
    misfit: float = 1.0,
) -> list[dict[str, str]]:
    """What seems to be wrong with a run, by its `findings`.

    After so many iterations the loss can fall by its part `gain`; `support` is where density was
    sought, and `doubt` what is odd in its box; images are off by `misfit` times what noise and the
    model's own error explain. Each is a word that names its `kind`, and a
    sentence, its `text`.
    """
    scene, quality = findings.scene, findings.quality
    train, test = ([v for v in findings.seen if v.is_test is is_test] for is_test in (False, True))
    overfit = None
    if train and test:
        psnrs = (mean(quality[view.name]["psnr"] for view in views) for views in (train, test))
        worse = next(psnrs) - next(psnrs)
        overfit = worse >= OVERFIT and (
            f"overfit: views held out are {worse:.1f} dB worse than those trained on; raise "
            "optimize.parameters.density.tv, add views, take the bounds that `ddrecon check` "
            "prints, or look for cameras that are off"
        )
    if support is not None:
        doubt = f"volume.bounds? {doubt}" if doubt else find_cut(support, scene.volume.grid)
    texts = {"empty": find_empty(scene, iteration, gain), "overfit": overfit, "support": doubt}
    if not texts["empty"]:
        texts |= find_odd(train, findings.images, gain)
    if not (texts["empty"] or overfit):  # which would only become more so
        texts["unfinished"] = find_unfinished(gain, iteration)
    if misfit > UNEXPLAINED and not any(texts.values()):
        texts["unexplained"] = (
            f"unexplained: at rest, images are off by {misfit:.1f} times what noise and the "
            "model's own error explain; check the directions and strengths of lights, albedo and g"
        )
    return [{"kind": kind, "text": text} for kind, text in texts.items() if text]


def find_empty(scene: Scene, iteration: int, gain: float) -> str | None:
    """Whether nothing is in the volume of `scene`, and why, as far as the run can see.

    Of a run that cannot see any smoke, for its lights, cameras or masks, the scene is refused.
    """
    volume = scene.volume
    depth = float((extinction_of(volume).amax(0) * volume.density).max()) * max(volume.grid.extent)
    if depth > THINNEST or (volume.emission is not None and bool(volume.emission.any())):
        return None
    if gain == math.inf:
        reason = f"the run ended after {iteration} iterations, before anything moved"
        return f"empty: {reason}; go on with --resume --iterations auto"
    return (
        "empty: no smoke that was tried brings renders nearer to the pictures than what is behind "
        "the box; check the directions of lights, cameras, masks and the bounds of density"
    )


def find_odd(views: Sequence[View], images: Mapping[str, Tensor], gain: float) -> dict[str, str]:
    """Which renders, of `images`, fit the pictures of `views` better by a factor, or when moved.

    Factors count from the usual one. The loss can still fall by its part `gain`.
    """
    factors = {view.name: best_factor(view, images[view.name], 1.0)[0] for view in views}
    usual = median(factors.values()) if len(views) > 2 else 1.0
    # What is not yet explained is no picture's fault as long as going on may explain it. It is all
    # where a run is too short to tell, and where renders as a whole lack the usual factor.
    to_come = min(gain, 1.0) if abs(math.log(usual)) <= math.log(FACTOR) else 1.0
    lit, moved = dict[str, float](), dict[str, float]()
    for view in views:
        factor, explained = best_factor(view, images[view.name], usual)
        if abs(math.log(factor)) > math.log(FACTOR) and explained > max(EXPLAINED, to_come):
            lit[view.name] = factor
        move, explained = best_shift(view, images[view.name])
        if math.hypot(*move) > SHIFT and explained > max(MOVED, to_come):
            moved[view.name] = math.hypot(*move)
    brightest = sorted(lit, key=lambda name: -abs(math.log(lit[name])))[:MOST_NAMED]
    farthest = sorted(moved, key=lambda name: -moved[name])[:MOST_NAMED]
    texts = {
        "exposure": "exposure? pictures brighter or darker, as a whole, than the others say: "
        f"{', '.join(f'{name} ({lit[name]:.2f} times)' for name in brightest)}; give all one "
        "exposure and white balance, or optimize them (views.*.exposure)",
        "cameras": "cameras? renders fit better when moved: "
        f"{', '.join(f'{name} ({moved[name]:.1f} pixels)' for name in farthest)}; check poses and "
        "intrinsics, or optimize the poses (views.NAME.camera)",
    }
    return {kind: texts[kind] for kind, odd in (("exposure", lit), ("cameras", moved)) if odd}


def find_unfinished(gain: float, iteration: int) -> str | None:
    """Whether going on after so many iterations would lower the loss, by its part `gain`.

    It is infinite in a run that is too short to tell.
    """
    if not WORTHWHILE <= gain < math.inf:
        return None
    much = f"some {100 * gain:.0f} %" if gain < 0.5 else "more than half"
    return (
        f"unfinished: the loss can still fall, by {much} as the search has it; "
        f"go on with --resume --iterations {2 * iteration}"
    )


def best_factor(view: View, image: Tensor, usual: float) -> tuple[float, float]:
    """The factor on the `usual` times the render `image` by which it fits best.

    And the part that it explains of what the usual factor leaves.
    """
    (change,), explained = explain(view, target_of(view) - usual * image, image[None])
    return max(1 + change / usual, 1e-12), explained


def best_shift(view: View, image: Tensor) -> tuple[list[float], float]:
    """The shift in pixels (right, down) by which the render `image` [3, h, w] fits best.

    Also returns the part of the residual to the picture of `view` that the shift explains. The
    shift is one Gauss-Newton step: the residual is fitted by the derivatives of the render along
    both axes (central differences; Lucas and Kanade 1981).
    """
    # A render moved to the right by d is r(x - d): it changes by -d times its derivative.
    slopes = torch.zeros(2, *image.shape).to(image)
    slopes[0, :, 1:-1, 1:-1] = (image[:, 1:-1, :-2] - image[:, 1:-1, 2:]) / 2
    slopes[1, :, 1:-1, 1:-1] = (image[:, :-2, 1:-1] - image[:, 2:, 1:-1]) / 2
    residual = torch.zeros_like(image)
    residual[:, 1:-1, 1:-1] = (target_of(view) - image)[:, 1:-1, 1:-1]
    return explain(view, residual, slopes)


def explain(view: View, residual: Tensor, slopes: Tensor) -> tuple[list[float], float]:
    """The factors of `slopes` [n, 3, h, w] that fit a `residual` [3, h, w] best, by least squares.

    And the part of it that they explain. Pixels count where the mask of `view` is not black.
    """
    weight, count = 1.0 if view.mask is None else view.mask, len(slopes)
    slopes, residual = (slopes * weight).double().flatten(1), (residual * weight).double().flatten()
    normal, total = slopes @ slopes.T, float(residual @ residual)
    if total == 0 or float(torch.linalg.det(normal)) <= 1e-9 * float(normal.trace()) ** count:
        return [0.0] * count, 0.0
    factors = torch.linalg.solve(normal, slopes @ residual)
    unexplained = residual - factors @ slopes
    return factors.tolist(), 1 - float(unexplained @ unexplained) / total
