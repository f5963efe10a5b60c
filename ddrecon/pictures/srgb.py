"""The sRGB transfer curve (IEC 61966-2-1): between linear radiance and displayed values."""

from __future__ import annotations

import numpy as np
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


def encode(linear: np.ndarray) -> np.ndarray:
    """`display` of an array."""
    return display(torch.from_numpy(np.array(linear))).numpy()


def encode_bytes(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of any `linear` values, clipped to [0, 1], NaN as 0; uint8, same shape."""
    return np.round(255 * encode(np.nan_to_num(linear))).astype(np.uint8)


def decode(encoded: np.ndarray) -> np.ndarray:
    """Linear values in [0, 1] of sRGB-`encoded` ones in [0, 1], same shape."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
