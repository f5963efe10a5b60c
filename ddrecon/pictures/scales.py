"""The scales on which pictures are compared: linear radiance, displayed values, stabilized ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ddrecon.pictures.display import display, display_slope
from ddrecon.pictures.noise import Noise, estimate_noise

NODES = 1025
"""Places between which the stabilized scale is interpolated, close together near black."""


LINEAR = "linear radiance"
COMPARED = {"display": "displayed values (sRGB)", "photon": "radiance in units of its noise"}
"""What losses compare, in words, where that is not linear radiance."""


class Scale(Protocol):
    """A scale, and its `peak` where that is the same for all pictures."""

    @property
    def peak(self) -> float | None: ...

    def values(self, radiance: Tensor) -> Tensor:
        """What linear `radiance` is on this scale."""

    def slope(self, target: Tensor) -> Tensor:
        """The derivative of the scale at `target` [3, h, w], or one for all of it."""


@dataclass(frozen=True)
class Linear:
    """Linear radiance itself."""

    peak: float | None = None

    def values(self, radiance: Tensor) -> Tensor:
        return radiance

    def slope(self, target: Tensor) -> Tensor:
        return target.new_ones(1, 1, 1)


@dataclass(frozen=True)
class Displayed:
    """Values as displayed, sRGB in [0, 1]."""

    peak: float | None = 1.0

    def values(self, radiance: Tensor) -> Tensor:
        return display(radiance)

    def slope(self, target: Tensor) -> Tensor:
        return display_slope(target)


@dataclass(frozen=True)
class Stabilized:
    """Radiance in units of its `noise`: the integral of 1 / deviation from black (E26).

    On this scale noise is the same everywhere, 1.
    """

    noise: Noise
    peak: float | None = None

    def values(self, radiance: Tensor) -> Tensor:
        top = radiance.max().clamp(min=torch.finfo(radiance.dtype).tiny).double()
        places = top * torch.linspace(0, 1, NODES, dtype=torch.float64, device=top.device) ** 2
        density = 1 / self.noise.deviation(places)
        steps = places.diff() * (density[1:] + density[:-1]) / 2
        heights = torch.cat([steps.new_zeros(1), steps.cumsum(0)])
        at = ((radiance / top).clamp(min=0).sqrt() * (NODES - 1)).clamp(max=NODES - 1)
        below = at.long().clamp(max=NODES - 2)
        part = (radiance - places[below]) / (places[below + 1] - places[below])
        stabilized = heights[below] + part * (heights[below + 1] - heights[below])
        return stabilized.to(radiance.dtype)

    def slope(self, target: Tensor) -> Tensor:
        # By the mean of neighbors: a weight that follows the noise would prefer what it darkens.
        level = avg_pool2d(target, 5, 1, 2, count_include_pad=False)
        return 1 / self.noise.deviation(level)


def scale_of(loss: str, image: Tensor, noise: Noise | None) -> Scale:
    """The scale on which `loss` compares `image` [3, h, w], with `noise` or what is estimated."""
    if loss == "photon":
        return Stabilized(noise or estimate_noise(image, 0.0))
    return Displayed() if loss == "display" else Linear()
