"""What a reconstruction makes small: the views' losses plus penalties; and its images' PSNR."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.losses import image_loss, psnr
from ddrecon.reconstruct.divergence import NotFiniteError
from ddrecon.reconstruct.gradients import Differentiated
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.renderer import render_each
from ddrecon.scene import Scene, View
from ddrecon.variables.values import variable_names, with_values


def target_of(view: View) -> Tensor:
    """The image [3, h, w] that `view` is to show. Raises ValueError where it has none."""
    if view.image is None:
        raise ValueError(f"view {view.name} has no image")
    return view.image


def loss_by_view(loss: str, views: Sequence[View]) -> Callable[[View, Tensor], Tensor]:
    """A function of one of `views` and its rendered image: what it adds to the objective.

    That is its share, by weight, of their mean `loss`; where it is not finite, NotFiniteError.
    """
    weights = sum(view.weight for view in views)

    def loss_of(view: View, image: Tensor) -> Tensor:
        value = view.weight / weights * image_loss(loss, image, target_of(view), view.mask)
        if not bool(torch.isfinite(value)):
            raise NotFiniteError(f"the loss of view {view.name} is not finite")
        return value

    return loss_of


def add_penalties(
    objective: Differentiated, parameters: Sequence[Parameter], power: float
) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss of `objective` and its gradients by name, with the penalties of `parameters` added.

    `power` [radiance squared] is the mean square of the targets, the unit of penalties: brighter
    light or a wider frame change nothing.
    """
    loss, gradients = objective.loss, dict(objective.gradients)
    for parameter in parameters:
        if parameter.tv or parameter.l1:
            penalty = power * parameter.penalty()
            loss = loss + penalty.detach()
            gradients[parameter.name] += torch.autograd.grad(penalty, parameter.value)[0]
    return loss, gradients


def mean_psnr(images: Sequence[Tensor], views: Sequence[View]) -> float:
    """The mean over `views` of the PSNR [dB] of their rendered `images` [3, h, w]."""
    values = [
        psnr(image, target_of(view), view.mask) for image, view in zip(images, views, strict=True)
    ]
    return sum(values) / len(values)


def render_psnr(scene: Scene, values: Mapping[str, Tensor], memory: SolveMemory) -> float:
    """The mean PSNR [dB] of the views of `scene`, rendered with those `values` that it has."""
    known = variable_names(scene)
    with torch.no_grad():
        rendered = with_values(scene, {name: values[name] for name in values if name in known})
        return mean_psnr(render_each(rendered, rendered.views, memory), rendered.views)
