"""The sRGB transfer curve (IEC 61966-2-1) of tensors: linear radiance as it is displayed."""

from __future__ import annotations

import torch
from torch import Tensor

TOE = 0.0031308
"""Below this radiance the curve is a straight line."""


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
