"""How far rendered images are from their targets, and how rough a field is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.grid import Grid

ROUNDING = 1e-2
"""Gradients below this, in units of one over the box's shortest side, are penalized quadratically
rather than as total variation.
"""


HUBER = 0.05
"""Errors above this part of the targets' root mean square count linearly in the Huber loss."""
RELATIVE = 0.05
"""The same part, added to a pixel's target, keeps relative errors finite where targets are black.
"""


def l2(error: Tensor, target: Tensor, scale: Tensor) -> Tensor:
    """The square of each entry of `error`; `scale` plays no part."""
    return error**2


def l1(error: Tensor, target: Tensor, scale: Tensor) -> Tensor:
    """The magnitude of `error` times `scale`: a radiance squared, as all losses are."""
    return error.abs() * scale


def huber(error: Tensor, target: Tensor, scale: Tensor) -> Tensor:
    """The square of `error` up to `HUBER` times `scale`, and a straight line beyond.

    Huber 1964, doi:10.1214/aoms/1177703732.
    """
    return (
        2
        * torch.nn.functional.huber_loss(
            error / scale, torch.zeros_like(error), reduction="none", delta=HUBER
        )
        * scale**2
    )


def relative_l2(error: Tensor, target: Tensor, scale: Tensor) -> Tensor:
    """The square of `error` over the target, so that dark pixels count as much as bright ones.

    The quotient is multiplied by `scale`, and the target raised by `RELATIVE` of it.
    """
    return (error / (target.abs() + RELATIVE * scale)) ** 2 * scale**2


LOSSES: dict[str, Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    "l2": l2,
    "l1": l1,
    "huber": huber,
    "relative_l2": relative_l2,
}


@dataclass(frozen=True)
class Target:
    """What images are compared with: `image` [3, h, w] (linear radiance), and its measures.

    `seen` [h, w] is 1 where a pixel counts and 0 where it does not; None counts all. `count`: of
    numbers that do; `scale`: the root of their mean square; `peak`: the largest value squared.
    """

    image: Tensor
    seen: Tensor | None
    count: Tensor
    scale: Tensor
    peak: Tensor

    @staticmethod
    def of(image: Tensor, mask: Tensor | None) -> Target:
        """The target `image`, of which `mask` [h, w] is seen; None is all of it."""
        tiny = torch.finfo(image.dtype).tiny
        if mask is None:
            count, square = image.new_full((), image[0].numel() * 3), image.square()
        else:
            count, square = (3 * mask.sum()).clamp(min=1), image.square() * mask
        scale = (square.sum() / count).sqrt().clamp(min=tiny**0.25)
        return Target(image, mask, count, scale, image.max().clamp(min=tiny) ** 2)

    def loss_of(self, loss: str, image: Tensor) -> Tensor:
        """The mean of `loss` over the pixels and colors of `image` [3, h, w]."""
        error = LOSSES[loss](image - self.image, self.image, self.scale)
        return (error if self.seen is None else error * self.seen).sum() / self.count

    def psnr_of(self, square: Tensor) -> Tensor:
        """The peak signal-to-noise ratio [dB] of a mean `square` of errors."""
        tiny = torch.finfo(square.dtype).tiny
        return 10 * torch.log10(self.peak / square.clamp(min=tiny))


def image_loss(loss: str, image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """The mean of `loss` over the pixels and colors of `image` [3, h, w] against `target`.

    Pixels where `mask` [h, w] is 0 do not count; None counts all.
    """
    return Target.of(target, mask).loss_of(loss, image)


def psnr(image: Tensor, target: Tensor, mask: Tensor | None) -> float:
    """The peak signal-to-noise ratio [dB] of `image` against `target`, both [3, h, w].

    The peak is the largest value of the target. Pixels where `mask` [h, w] is 0 do not count.
    """
    known = Target.of(target, mask)
    return float(known.psnr_of(known.loss_of("l2", image.detach())))


def total_variation(field: Tensor, grid: Grid) -> Tensor:
    """The mean length of the gradient of `field` [..., z, y, x] over the cells of `grid`.

    The gradient is by position in units of the box's shortest side.

    Isotropic total variation (Rudin, Osher, Fatemi 1992, doi:10.1016/0167-2789(92)90242-F), the
    same at every resolution and world scale, and rounded off at zero so that its derivative is
    finite in flat regions.
    """
    side = min(grid.extent)
    square = torch.full_like(field, ROUNDING**2)
    for axis, spacing in zip((-3, -2, -1), grid.spacing, strict=True):
        slope = (field.diff(dim=axis) * (side / spacing)) ** 2
        square = square + torch.cat([slope, torch.zeros_like(field.narrow(axis, 0, 1))], axis)
    return (square.sqrt() - ROUNDING).mean()
