"""The sRGB transfer curve (IEC 61966-2-1): between linear radiance and what 8-bit files store."""

from __future__ import annotations

import numpy as np


def decode(encoded: np.ndarray) -> np.ndarray:
    """Linear values in [0, 1] of sRGB-`encoded` ones in [0, 1], same shape."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def encode(linear: np.ndarray) -> np.ndarray:
    """sRGB-encoded values in [0, 1] of `linear` ones in [0, 1], same shape."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def encode_bytes(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of any `linear` values, clipped to [0, 1], NaN as 0; uint8, same shape."""
    return np.round(255 * encode(np.clip(np.nan_to_num(linear), 0, 1))).astype(np.uint8)
