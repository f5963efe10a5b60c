"""The scales on which pictures are compared, and how alike they are in structure."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from ddrecon.pictures.noise import Noise, estimate_noise
from ddrecon.pictures.srgb import display, display_slope

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
