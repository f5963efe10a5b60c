"""The objective of a reconstruction: the views' losses plus penalties; and its images' PSNR."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import islice

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import DivergenceError, SolveError
from ddrecon.losses import Target
from ddrecon.picture import render_each
from ddrecon.ranks import sum_numbers
from ddrecon.reconstruct.gradients import Differentiated, own_views
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import RESPONSE
from ddrecon.variables.values import variable_names, with_values


def target_of(view: View) -> Tensor:
    """The image [3, h, w] that `view` is to show. Raises ValueError where it has none."""
    if view.image is None:
        raise ValueError(f"view {view.name} has no image")
    return view.image


class Comparison:
    """Compares images of `views` with their `targets` by name, each once.

    `pictures` are this rank's images so far, by name, and `losses` and `psnrs` what they came to.
    """

    def __init__(self, views: Sequence[View], targets: Mapping[str, Target]):
        self.views, self.targets = views, targets
        self.forget()

    def forget(self) -> None:
        """Forgets all images."""
        self.pictures: dict[str, Tensor] = {}
        self.losses, self.psnrs = list[Tensor](), list[Tensor]()

    def __call__(self, view: View, image: Tensor) -> Tensor:
        """What `view` and its `image` add to the objective: its share, by weight, of the mean."""
        loss = self.loss_of(view, image)
        self.note(view, image.detach(), loss.detach())
        return loss

    def loss_of(self, view: View, image: Tensor) -> Tensor:
        """The same, of which nothing is kept."""
        return self.share(view) * self.targets[view.name].loss_of(image)

    def note(self, view: View, image: Tensor, loss: Tensor, psnr: Tensor | None = None) -> None:
        """Keeps the `image` of `view`, the `loss` that it adds, and its quality (`psnr`)."""
        self.pictures[view.name] = image
        self.losses.append(loss)
        self.psnrs.append(self.targets[view.name].psnr_of(image) if psnr is None else psnr)

    def similarity(self) -> float:
        """The mean SSIM of all views."""
        values = [self.targets[name].ssim_of(image) for name, image in self.pictures.items()]
        return sum_numbers([float(sum(values))])[0] / len(self.views)

    def share(self, view: View) -> float:
        """The part of the mean loss that `view` has, by weight."""
        return view.weight / sum(view.weight for view in self.views)

    def require_finite(self) -> None:
        """Raises NotFiniteError where the loss of a view of this rank's is not finite."""
        for name, loss in zip(self.pictures, self.losses, strict=False):
            if not math.isfinite(loss):
                raise NotFiniteError(f"the loss of view {name} is not finite")

    def read(
        self, objective: Differentiated, penalty: Tensor, parameters: Sequence[Parameter]
    ) -> tuple[float, float, float] | None:
        """The loss of images of an iteration, its `penalty`, and the images' mean PSNR [dB].

        All are read at once, with the extremes of the derivatives. None where a solve did not end.
        Raises NotFiniteError where a loss, or a derivative by one of the `parameters`, is not
        finite.
        """
        gradients = objective.gradients
        extremes = [x for gradient in gradients.values() for x in gradient.aminmax()]
        residuals = [residual.to(penalty) for residual, _ in objective.residuals]
        groups = [[objective.loss, penalty], residuals, extremes, self.psnrs]
        flat = iter(torch.stack([number for group in groups for number in group]).tolist())
        (of_images, prior), errors, ends, psnrs = (list(islice(flat, len(g))) for g in groups)
        limits = (limit for _, limit in objective.residuals)
        if not all(error <= limit for error, limit in zip(errors, limits, strict=True)):
            return None
        if not all(map(math.isfinite, [of_images, prior, *ends])):
            self.require_finite()
            for p in parameters:
                if place := describe_flaw(p.name, gradients[p.name], p.is_field):
                    slope = f"the derivative of the loss with respect to {place}"
                    raise NotFiniteError(f"{slope} is not finite")
            raise NotFiniteError("the loss is not finite")
        (psnr,) = sum_numbers([sum(psnrs)])
        return of_images, prior, psnr / len(self.views)


def render_quality(
    scene: Scene,
    parameters: Sequence[Parameter],
    targets: Mapping[str, Target],
    memory: SolveMemory,
) -> tuple[float, float]:
    """The mean PSNR [dB] and SSIM of the test views of `scene` against their `targets` by name.

    They are rendered with those `parameters` that the scene has, and with the exposure that fits
    each best where exposures are among them.
    """
    variables, names = variable_names(scene), [view.name for view in scene.views]
    psnrs, ssims = list[Tensor](), list[Tensor]()
    with torch.no_grad():
        values = {p.name: p.value for p in parameters if p.name in variables}
        rendered = with_values(scene, values)
        views = [rendered.view(name) for name in own_views(scene, names)]
        for view, image in zip(views, render_each(rendered, views, memory), strict=True):
            target = targets[view.name]
            fitted, _ = fit_held_out(image, view, target, response_sizes(parameters))
            psnrs.append(target.psnr_of(fitted))
            ssims.append(target.ssim_of(fitted))
    psnr, ssim = sum_numbers([float(sum(psnrs)), float(sum(ssims))])
    return psnr / len(names), ssim / len(names)


def response_sizes(parameters: Sequence[Parameter]) -> dict[str, int]:
    """How many numbers exposure and offset of a view have, of those that are `parameters`."""
    return {p.key: len(p.value) for p in parameters if p.view is not None and p.key in RESPONSE}


def fit_held_out(
    picture: Tensor, view: View, target: Target, sizes: Mapping[str, int]
) -> tuple[Tensor, dict[str, Tensor]]:
    """The `picture` [3, h, w] of a test `view` with the response that fits its own `target` best.

    And that response by key: those of exposure and offset that `sizes` names, by `response_sizes`.
    Least squares weigh errors in the dark more than the PSNR of displayed pictures does, and may
    harm a picture that is far off: then the exposure alone is fitted, or nothing.
    """
    response = {
        key: picture.new_full((1,), default) if getattr(view, key) is None else getattr(view, key)
        for key, default in RESPONSE.items()
    }
    response = {key: value.expand(sizes.get(key, len(value))) for key, value in response.items()}
    exposure, offset = (response[key].view(-1, 1, 1) for key in ("exposure", "offset"))
    # A background behind the volume counts as if it were exposed with it.
    light = (picture - offset) / exposure
    basis = {"exposure": light, "offset": torch.ones_like(light)}
    weight = target.slope if target.seen is None else target.slope * target.seen
    ones = {1: light.new_ones(1, 3), 3: torch.eye(3).to(light)}
    tried = [(picture, response)]
    for keys in (["exposure"], ["offset"], ["exposure", "offset"]):
        if sizes.keys() >= set(keys):
            # Least squares, weighed as the target's loss weighs small errors.
            columns = torch.cat([ones[sizes[key]][..., None, None] * basis[key] for key in keys])
            fixed = sum(response[k].view(-1, 1, 1) * basis[k] for k in basis if k not in keys)
            matrix, right = (
                (image * weight).double().cpu().flatten(-3)
                for image in (columns, target.image - fixed)
            )
            # A response that a picture does not show, such as the exposure of black, is 0.
            solution = torch.linalg.pinv(matrix @ matrix.T, hermitian=True) @ (matrix @ right)
            values = solution.to(light).split([sizes[key] for key in keys])
            fit = response | dict(zip(keys, values, strict=True))
            picture = fit["exposure"].view(-1, 1, 1) * light + fit["offset"].view(-1, 1, 1)
            tried.append((picture, fit))
    fitted, best = max(tried, key=lambda attempt: float(target.psnr_of(attempt[0])))
    return fitted, {key: best[key] for key in sizes}


class NotFiniteError(Exception):
    """A number of the iteration being made is not finite; the text says which."""


def explain_divergence(
    iteration: int, parameters: Sequence[Parameter], error: SolveError | NotFiniteError
) -> DivergenceError:
    """What is raised where `iteration`, counted from 1, failed by `error`.

    It names the largest value of each of the `parameters`, and advises to bound them.
    """
    reason, residual, advice = str(error), math.nan, ""
    if isinstance(error, SolveError):
        reason, residual = reason.partition(";")[0], error.residual
        if math.isfinite(residual):
            advice = f"{error.advice}, or "
        else:
            reason = "the light is not finite"
    largest = list[str]()
    for p in parameters:
        values = p.value.detach()
        index = torch.unravel_index(values.abs().argmax(), values.shape)
        name = _name_entry(p.name, [int(i) for i in index], p.is_field)
        largest.append(f"{name} is {float(values[index]):.4g}")
    names = " and ".join(f"optimize.parameters.{p.name}" for p in parameters)
    reason = f"{reason}; at most, {'; '.join(largest)}"
    advice += f"give another start (init) or bounds (min, max) to {names}"
    return DivergenceError(iteration, reason, residual, advice)


def describe_flaw(name: str, values: Tensor, is_field: bool) -> str | None:
    """The first entry of `values` that is not finite, as `density at voxel [x, y, z]`, or None.

    `values` belong to the parameter `name`.
    """
    flaws = torch.nonzero(~torch.isfinite(values.detach()))
    return _name_entry(name, flaws[0].tolist(), is_field) if len(flaws) else None


def _name_entry(name: str, index: list[int], is_field: bool) -> str:
    """An entry of the parameter `name` in words; places of fields and maps in world order."""
    if not is_field and len(index) != 3:
        return f"{name}, entry {index}" if index else name
    kind, count = ("voxel", 3) if is_field else ("pixel", 2)
    place, color = index[-count:][::-1], index[:-count]
    return f"{name} at {kind} {place}" + (f", color {color[0]}" if color else "")
