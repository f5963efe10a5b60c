"""What pictures are: how they are displayed, how they err, on what scale they are compared."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from ddrecon.records import bounded

TOE = 0.0031308
"""Below this radiance the curve is a straight line."""
LEAST = 1e-3
"""A picture errs by at least this part of its root mean square: nothing is known better."""
BINS = 16
"""Levels of brightness, with as many pixels each, among which noise is looked for."""
NORMAL = 0.6745
"""The median magnitude of normal noise over its standard deviation."""
SIDE = 32
NODES = SIDE**2 + 1
"""Places between which the stabilized scale is interpolated, close together near black."""
RADIUS, DEVIATION = 5, 1.5
"""The Gaussian window, in pixels: 11 x 11."""
K1, K2 = 0.01, 0.03
"""Parts of the peak that keep quotients finite in flat places."""
LINEAR = "linear radiance"
COMPARED = {"display": "displayed values (sRGB)", "photon": "radiance in units of its noise"}
"""What losses compare, in words, where that is not linear radiance."""


def display(linear: Tensor) -> Tensor:
    """The displayed values in [0, 1] of `linear` radiance, whose display is white from 1 on."""
    linear = linear.clamp(0, 1)
    return torch.where(
        linear <= TOE, 12.92 * linear, 1.055 * linear.clamp(min=TOE) ** (1 / 2.4) - 0.055
    )


def display_slope(linear: Tensor) -> Tensor:
    """The derivative of displayed values by `linear` radiance, 12.92 from black to `TOE`.

    Above 1 it is that of the curve without its end at white.
    """
    return torch.where(linear <= TOE, 12.92, 1.055 / 2.4 * linear.clamp(min=TOE) ** (1 / 2.4 - 1))


def encode(linear: np.ndarray) -> np.ndarray:
    """`display` of an array."""
    return display(torch.from_numpy(np.array(linear))).numpy()


def encode_bytes(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of any `linear` values, clipped to [0, 1], NaN as 0; uint8, same shape."""
    return np.round(255 * encode(np.nan_to_num(linear))).astype(np.uint8)


def decode(encoded: np.ndarray) -> np.ndarray:
    """Linear values in [0, 1] of sRGB-`encoded` ones in [0, 1], same shape."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


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


@dataclass(frozen=True)
class Scale:
    """Linear radiance itself; others change it. `peak` is that of all pictures, if it is one."""

    peak: float | None = None

    def values(self, radiance: Tensor) -> Tensor:
        """What linear `radiance` is on this scale."""
        return radiance

    def slope(self, target: Tensor) -> Tensor:
        """The derivative of the scale at `target` [3, h, w], or one for all of it."""
        return target.new_ones(1, 1, 1)


@dataclass(frozen=True)
class Displayed(Scale):
    """Values as displayed, sRGB in [0, 1]."""

    peak: float | None = 1.0

    def values(self, radiance: Tensor) -> Tensor:
        return display(radiance)

    def slope(self, target: Tensor) -> Tensor:
        return display_slope(target)


@dataclass(frozen=True, kw_only=True)
class Stabilized(Scale):
    """Radiance in units of its `noise`: the integral of 1 / deviation from black (E9.2).

    On this scale noise is the same everywhere, 1.
    """

    noise: Noise

    def values(self, radiance: Tensor) -> Tensor:
        top = radiance.max().clamp(min=torch.finfo(radiance.dtype).tiny).double()
        places = top * torch.linspace(0, 1, NODES, dtype=torch.float64, device=top.device) ** 2
        slopes = 1 / self.noise.deviation(places)
        # Summed up to each node by rows: on a GPU `cumsum` has no fixed order.
        areas = ((slopes[1:] + slopes[:-1]) / 2 * places.diff()).view(SIDE, SIDE)
        ones = torch.ones_like(areas)
        rows = areas @ ones.triu()
        sums = rows + ones.tril(-1) @ rows[:, -1:]
        heights = torch.cat([places[:1], sums.flatten()])
        at = ((radiance / top).clamp(min=0).sqrt() * (NODES - 1)).clamp(max=NODES - 1)
        below = at.long().clamp(max=NODES - 2)
        fraction = (radiance - places[below]) / (places[below + 1] - places[below])
        stabilized = heights[below] + fraction * (heights[below + 1] - heights[below])
        return stabilized.to(radiance.dtype)

    def slope(self, target: Tensor) -> Tensor:
        # Neighbors are averaged: a weight that follows the noise would prefer darkened pixels.
        level = avg_pool2d(target, 5, 1, 2, count_include_pad=False)
        return 1 / self.noise.deviation(level)


def scale_of(loss: str, image: Tensor, noise: Noise | None) -> Scale:
    """The scale on which `loss` compares `image` [3, h, w], with `noise` or what is estimated."""
    if loss == "photon":
        return Stabilized(noise=noise or estimate_noise(image, 0.0))
    return Displayed() if loss == "display" else Scale()


def structural_similarity(
    image: Tensor, reference: Tensor, peak: Tensor, seen: Tensor | None = None
) -> Tensor:
    """The structural similarity [c, h, w] of two images [c, h, w] whose largest value is `peak`.

    Wang et al. 2004, doi:10.1109/TIP.2003.819861, with their window. At an edge it is cut off, and
    where `seen` [h, w] is 0.
    """
    place = torch.arange(-RADIUS, RADIUS + 1).to(image)
    window = torch.exp(-0.5 * (place / DEVIATION) ** 2)

    def blur(values: Tensor) -> Tensor:
        padded = pad(values[:, None], (RADIUS,) * 4)
        return conv2d(conv2d(padded, window.view(1, 1, -1, 1)), window.view(1, 1, 1, -1))[:, 0]

    seen = torch.ones_like(image[0]) if seen is None else seen
    weight = blur(seen[None]).clamp(min=torch.finfo(seen.dtype).tiny)

    def mean(values: Tensor) -> Tensor:
        return blur(values * seen) / weight

    first, second = mean(image), mean(reference)
    contrast = mean(image * image) - first**2 + mean(reference * reference) - second**2
    structure = mean(image * reference) - first * second
    low, high = (K1 * peak) ** 2, (K2 * peak) ** 2
    return ((2 * first * second + low) * (2 * structure + high)) / (
        (first**2 + second**2 + low) * (contrast + high)
    )
