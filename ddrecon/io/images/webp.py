"""Pictures within pages as WebP: smaller than PNG, and moving ones far smaller.

Everything here is 8-bit sRGB, uint8 [h, w, 3] or [n, h, w, 3].
"""

from __future__ import annotations

from typing import Any

import numpy as np

QUALITY = 82
"""Of moving pictures, which are looked at in passing."""


def webp_of(image: np.ndarray) -> bytes:
    """`image` [h, w, 3], every pixel as it is."""
    return _encode(image, lossless=True, quality=90, method=4)


def moving_webp_of(frames: np.ndarray, seconds: float) -> bytes:
    """`frames` [n, h, w, 3], which take `seconds` once around, and go on for ever."""
    return _encode(frames, duration=1000 * seconds / len(frames), loop=0, quality=QUALITY)


def _encode(pixels: np.ndarray, **settings: Any) -> bytes:
    import imageio.v3 as iio

    content: bytes = iio.imwrite("<bytes>", pixels, plugin="pillow", extension=".webp", **settings)
    return content
