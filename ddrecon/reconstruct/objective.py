"""What a reconstruction makes small: the views' losses plus penalties; and its images' PSNR."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import Target
from ddrecon.ranks import cells_are_shared
from ddrecon.reconstruct.divergence import NotFiniteError, require_finite
from ddrecon.reconstruct.gradients import Differentiated
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.responses import fit_held_out
from ddrecon.reconstruct.shares import gather_numbers, own_views
from ddrecon.renderer import render_each
from ddrecon.scene import Scene, View
from ddrecon.variables.values import variable_names, with_values


def target_of(view: View) -> Tensor:
    """The image [3, h, w] that `view` is to show. Raises ValueError where it has none."""
    if view.image is None:
        raise ValueError(f"view {view.name} has no image")
    return view.image


@dataclass
class Comparison:
    """Compares images of `views` with their `targets` by name, each once.

    `losses`, `psnrs` [dB] and, where `has_similarity`, `similarities` are those compared so far, in
    their order, and `chi_squares` those of views that have a target among `noise_targets`;
    `pictures` are the images by name. `gather` makes
    the numbers those of all views.
    """

    views: Sequence[View]
    targets: Mapping[str, Target]
    has_similarity: bool = False
    noise_targets: Mapping[str, Target] = field(default_factory=dict)
    pictures: dict[str, Tensor] = field(default_factory=dict)
    losses: list[Tensor] = field(default_factory=list)
    psnrs: list[Tensor] = field(default_factory=list)
    similarities: list[Tensor] = field(default_factory=list)
    chi_squares: list[Tensor] = field(default_factory=list)

    def __call__(self, view: View, image: Tensor) -> Tensor:
        """What `view` and its rendered `image` add to the objective.

        That is its share, by weight, of the views' mean loss.
        """
        target = self.targets[view.name]
        self.pictures[view.name] = image.detach()
        loss = target.loss_of(image)
        self.psnrs.append(target.psnr_of(image.detach()))
        if self.has_similarity:
            self.similarities.append(target.ssim_of(image.detach()))
        if view.name in self.noise_targets:
            self.chi_squares.append(self.noise_targets[view.name].loss_of(image.detach()))
        value = self.share(view) * loss
        self.losses.append(value.detach())
        return value

    def gather(self) -> None:
        """Learns what other ranks have compared, of which they keep the pictures."""
        names = [view.name for view in self.views]
        kinds = self.losses, self.psnrs, self.similarities, self.chi_squares
        wanted = True, True, self.has_similarity, bool(self.noise_targets)
        rows = [row for row, is_wanted in zip(kinds, wanted, strict=True) if is_wanted]
        for row, found in zip(rows, gather_numbers(rows, list(self.pictures), names), strict=True):
            row[:] = found

    def share(self, view: View) -> float:
        """The part of the mean loss that `view` has, by weight."""
        return view.weight / sum(view.weight for view in self.views)

    def require_finite(self) -> None:
        """Raises NotFiniteError where a loss is not finite."""
        for view, loss in zip(self.views, self.losses, strict=False):
            if not math.isfinite(loss):
                raise NotFiniteError(f"the loss of view {view.name} is not finite")


@dataclass(frozen=True)
class Numbers:
    """What Python knows of an iteration: the `loss`, its part of the images, their mean `psnr`.

    And their mean `ssim`, None where that was not looked at; `losses`, and chi^2 per pixel where
    noise is known, of each view by name.
    """

    loss: float
    of_images: float
    psnr: float
    ssim: float | None
    losses: Mapping[str, float]
    chi_squares: Mapping[str, float]

    @property
    def chi_square(self) -> float | None:
        """Their mean chi^2 per pixel; None where noise is not known."""
        known = self.chi_squares.values()
        return sum(known) / len(known) if known else None


def read_numbers(
    compared: Comparison,
    objective: Differentiated,
    loss: Tensor,
    gradients: Mapping[str, Tensor],
    parameters: Sequence[Parameter],
) -> Numbers:
    """The numbers of an iteration, all read at once, with `loss` and `gradients` of all there is.

    Raises NotFiniteError where a loss, or a derivative by one of the `parameters`, is not finite.
    """
    compared.gather()
    extremes = [x for gradient in gradients.values() for x in gradient.aminmax()]
    groups = [
        [loss, objective.loss],
        compared.psnrs,
        compared.similarities,
        compared.chi_squares,
        compared.losses,
        extremes,
    ]
    flat = iter(torch.stack([number for group in groups for number in group]).tolist())
    (total, of_images), psnrs, similarities, chi_squares, losses, ends = (
        list(islice(flat, len(group))) for group in groups
    )
    if not all(math.isfinite(number) for number in losses + ends):
        compared.require_finite()
        require_finite(parameters, gradients)
    count, names = len(psnrs), [view.name for view in compared.views]
    return Numbers(
        total,
        of_images,
        sum(psnrs) / count,
        sum(similarities) / count if similarities else None,
        {v.name: x / compared.share(v) for v, x in zip(compared.views, losses, strict=True)},
        dict(zip(names, chi_squares, strict=False)),
    )


def add_penalties(
    objective: Differentiated, parameters: Sequence[Parameter], power: float
) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of `objective` and its gradients by name, with the penalties of `parameters` added.

    `power` [radiance squared] is the mean square of the targets, the unit of penalties: brighter
    light or a wider frame change nothing.
    """
    loss, gradients = objective.loss, dict(objective.gradients)
    for parameter in parameters:
        if parameter.tv:
            penalty = parameter.penalty(power)
            loss = loss + penalty.detach()
            gradients[parameter.name] += torch.autograd.grad(penalty, parameter.value)[0]
    return loss, gradients


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
    known, names = variable_names(scene), [view.name for view in scene.views]
    own, rows = own_views(scene, names), [list[Tensor](), list[Tensor]()]
    with torch.no_grad():
        values = {p.name: p.value for p in parameters if p.name in known}
        rendered = with_values(scene, values)
        views = [rendered.view(name) for name in (names if cells_are_shared() else own)]
        for view, image in zip(views, render_each(rendered, views, memory), strict=True):
            if view.name not in own:
                continue
            target = targets[view.name]
            fitted, _ = fit_held_out(image, view, target, parameters)
            rows[0].append(target.psnr_of(fitted))
            rows[1].append(target.ssim_of(fitted))
    numbers = [torch.stack(row).mean() for row in gather_numbers(rows, own, names)]
    psnr, ssim = torch.stack(numbers).tolist()
    return psnr, ssim
