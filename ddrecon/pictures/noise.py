"""How much the values of a picture err: read noise, shot noise and quantization."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

from ddrecon.pictures.srgb import display_slope
from ddrecon.records import bounded

LEAST = 1e-3
"""A picture errs by at least this part of its root mean square: nothing is known better."""
BINS = 16
"""Levels of brightness, with as many pixels each, among which noise is looked for."""
NORMAL = 0.6745
"""The median magnitude of normal noise over its standard deviation."""


@dataclass(frozen=True)
class Noise:
    """The variance of a picture's values x: read^2 + shot x + that of quantization (E9.2).

    `read` >= 0 is the standard deviation at black, `shot` >= 0 the variance by radiance, `step` >=
    0 that between neighboring sRGB-encoded values: 1/255 in a picture of 8 bits, 0 in a linear one.
    """

    read: float = bounded(minimum=0)
    shot: float = bounded(minimum=0)
    step: float = bounded(0.0, minimum=0)

    def deviation(self, values: Tensor) -> Tensor:
        """The standard deviation of `values` of linear radiance; what is below black is as black.

        Quantization is uniform within a step, a twelfth of its square (Bennett 1948,
        doi:10.1002/j.1538-7305.1948.tb01340.x).
        """
        variance = self.read**2 + self.shot * values.clamp(min=0)
        if self.step:
            variance = variance + (self.step / display_slope(values)) ** 2 / 12
        return variance.sqrt()


def estimate_noise(image: Tensor, step: float) -> Noise:
    """The noise of `image` [3, h, w], found from how its pixels differ from their neighbors.

    At each of some levels of brightness, the deviation is that of differences which smooth pictures
    do not have (Immerkaer 1996, doi:10.1006/cviu.1996.0060), by their median, so that edges hardly
    count; a line through the variances is read and shot noise. A small picture has read noise only.
    """
    least = least_noise(image, step)
    if min(image.shape[1:]) < 3:
        return least
    colors = image[:, None]
    # Second differences of second differences: 0 where values are linear in rows or columns.
    line = image.new_tensor([1.0, -2.0, 1.0])
    uneven = conv2d(colors, torch.outer(line, line).view(1, 1, 3, 3)).flatten().abs() / 6
    level = avg_pool2d(colors, 3, 1).flatten()
    order = level.argsort()
    count = min(BINS, max(1, len(order) // 64))
    levels = torch.stack([level[pixels].mean() for pixels in order.tensor_split(count)])
    medians = torch.stack([uneven[pixels].median() for pixels in order.tensor_split(count)])
    variances = (medians / NORMAL) ** 2
    if step:  # which the differences have in them
        variances = (variances - (step / display_slope(levels)) ** 2 / 12).clamp(min=0)
    read_square, shot = _fit_line(levels.double(), variances.double())
    return Noise(max(read_square**0.5, least.read), shot, step)


def least_noise(image: Tensor, step: float) -> Noise:
    """The least noise that `image` [3, h, w] has."""
    size = image.square().mean().sqrt().clamp(min=torch.finfo(image.dtype).tiny)
    return Noise(LEAST * float(size), 0.0, step)


def _fit_line(places: Tensor, values: Tensor) -> tuple[float, float]:
    """The line value + slope x place through `values` >= 0, neither below 0, by least squares."""
    middle, mean = places.mean(), values.mean()
    tiny = torch.finfo(places.dtype).tiny
    away = places - middle
    slope = float((away * (values - mean)).sum() / away.square().sum().clamp(min=tiny))
    start = float(mean - slope * middle)
    if slope < 0:
        return float(mean), 0.0
    if start < 0:
        through_zero = float((places * values).sum() / places.square().sum().clamp(min=tiny))
        return 0.0, max(0.0, through_zero)
    return start, slope
