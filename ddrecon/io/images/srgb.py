"""The sRGB transfer curve (IEC 61966-2-1), between linear radiance and what 8-bit files store, both
in [0, 1].
"""

from __future__ import annotations

import numpy as np


def decode(encoded: np.ndarray) -> np.ndarray:
    """Linear values of sRGB-`encoded` ones, same shape."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def encode(linear: np.ndarray) -> np.ndarray:
    """sRGB-encoded values of `linear` ones in [0, 1], same shape."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
