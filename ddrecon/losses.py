"""How far rendered images are from their targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.pictures import Noise, Scale, scale_of, structural_similarity

HUBER = 0.05
"""Errors above this share of the target's scale count linearly in the Huber loss."""
RELATIVE = 0.05
"""This share of the target's scale keeps relative errors finite where targets are black."""
SMALL = 1e-3
"""Errors below this share of the target's scale are as good as none."""
WHITE = 1 - 1e-4
"""A displayed target this bright says only that it is at least white."""


def l2(error: Tensor, target: Target) -> Tensor:
    """The square of `error` times the slope of the target's scale: 1, but for the loss `photon`,
    whose errors are in units of the noise there (E9.2).
    """
    return (error * target.slope) ** 2


def l1(error: Tensor, target: Target) -> Tensor:
    """The magnitude of `error` times the target's scale: a radiance squared, as in `l2`."""
    return error.abs() * target.scale


def huber(error: Tensor, target: Target) -> Tensor:
    """The square of `error` up to `HUBER` times the target's scale, and a straight line beyond.

    Huber 1964, doi:10.1214/aoms/1177703732.
    """
    relative = (error / target.scale).abs()
    line = HUBER * (2 * relative - HUBER)
    return torch.where(relative < HUBER, relative**2, line) * target.scale**2


def relative_l2(error: Tensor, target: Target) -> Tensor:
    """The square of `error` over the target, so that dark pixels count as much as bright ones, in
    units of the target's scale.
    """
    return (error / (target.image.abs() + RELATIVE * target.scale)) ** 2 * target.scale**2


def display(error: Tensor, target: Target) -> Tensor:
    """The square of `error` in displayed values, by the slope of sRGB at the target (E9.3).

    It is quadratic however far off an image is: the curve itself would be steep where an image is
    still black, and flat where it is too bright. Pixels brighter than a white target do not err.
    """
    return l2(torch.where(target.image >= WHITE, error.clamp(max=0), error), target)


LOSSES: dict[str, Callable[[Tensor, Target], Tensor]] = {
    "l2": l2,
    "l1": l1,
    "huber": huber,
    "relative_l2": relative_l2,
    "display": display,
    "photon": l2,
}


@dataclass(frozen=True)
class Target:
    """What images are compared with, `image` [3, h, w] (linear radiance), and how: by a `loss`.

    `seen` [h, w] is 1 where a pixel counts and 0 where it does not; None counts all. `count`: how
    many numbers count; `scale`: the root of their mean square. Quality is measured on the scale
    `on`: `compared` is the image on it, `slope` its derivative there, and `peak` the largest value
    that counts.
    """

    loss: str
    image: Tensor
    seen: Tensor | None
    count: Tensor
    scale: Tensor
    on: Scale
    compared: Tensor
    slope: Tensor
    peak: Tensor

    @staticmethod
    def of(
        image: Tensor, mask: Tensor | None, loss: str = "l2", noise: Noise | None = None
    ) -> Target:
        """The target `image`, of which `mask` [h, w] is seen; None is all of it.

        `noise` is for the loss `photon`, estimated where it is None.
        """
        least = torch.finfo(image.dtype).tiny ** 0.25
        if mask is None:
            count, seen = image.new_full((), image[0].numel() * 3), image
        else:
            count, seen = (3 * mask.sum()).clamp(min=1), image * mask
        scale = (seen.square().sum() / count).sqrt().clamp(min=least)
        on = scale_of(loss, image, noise)
        compared = on.values(image)
        largest = (compared if mask is None else torch.where(mask > 0, compared, 0)).max()
        peak = largest.clamp(min=least) if on.peak is None else scale.new_tensor(on.peak)
        return Target(loss, image, mask, count, scale, on, compared, on.slope(image), peak)

    def loss_of(self, image: Tensor) -> Tensor:
        """The mean of the loss over the pixels and colors of `image` [3, h, w]."""
        return self._mean(LOSSES[self.loss](image - self.image, self))

    def weights_at(self, image: Tensor) -> Tensor:
        """The second derivative of `loss_of` by each entry of `image` [3, h, w]: W of E11.1.

        Of what is no square it is that of the parabola around 0 that touches the loss from above
        (Huber 1981, doi:10.1002/0471725250): its slope over the error, which counts as at least
        `SMALL` of the target's scale.
        """
        error, least = (image - self.image).detach(), SMALL * self.scale
        error = torch.where(error.abs() < least, least.copysign(error), error).requires_grad_()
        with torch.enable_grad():
            (slope,) = torch.autograd.grad(LOSSES[self.loss](error, self).sum(), error)
        weights = slope / error.detach() / self.count
        return weights if self.seen is None else weights * self.seen

    @property
    def power(self) -> Tensor:
        """The mean square of the target as it is compared, the unit of the loss."""
        return self._mean(self.compared.square())

    def psnr_of(self, image: Tensor) -> Tensor:
        """The peak signal-to-noise ratio [dB] of `image` [3, h, w], as it is compared."""
        square = self._mean((self.on.values(image) - self.compared).square())
        return 10 * torch.log10(self.peak**2 / square.clamp(min=torch.finfo(square.dtype).tiny))

    def ssim_of(self, image: Tensor) -> Tensor:
        """The structural similarity of `image` [3, h, w], as it is compared; at most 1."""
        images = self.on.values(image), self.compared
        return self._mean(structural_similarity(*images, self.peak, self.seen))

    def _mean(self, values: Tensor) -> Tensor:
        """The mean of `values` [3, h, w] over the numbers that count."""
        return (values if self.seen is None else values * self.seen).sum() / self.count
