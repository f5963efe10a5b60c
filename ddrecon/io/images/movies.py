"""Moving pictures as animated PNG; pictures within pages as WebP.

Frames and images are 8-bit sRGB, uint8 [n, h, w, 3] and [h, w, 3].
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.io.files.atomic import replace_file
from ddrecon.pictures import srgb

SECONDS = 4.0
"""How long a movie takes from its first frame back to it."""


def encode_frames(frames: Sequence[np.ndarray], white: float) -> np.ndarray:
    """`frames` [h, w, 3], linear, as 8-bit sRGB [n, h, w, 3]; radiance `white` > 0 is white."""
    return np.stack([srgb.encode_bytes(frame / white) for frame in frames])


def encode(pixels: np.ndarray, extension: str, **settings: Any) -> bytes:
    """An image or frames as a file of this kind, by Pillow."""
    import imageio.v3 as iio

    return iio.imwrite("<bytes>", pixels, plugin="pillow", extension=extension, **settings)


def webp_of(image: np.ndarray) -> bytes:
    """`image`, every pixel as it is: smaller than PNG."""
    return encode(image, ".webp", lossless=True, quality=90, method=4)


def write_animation(path: Path, frames: np.ndarray) -> None:
    """Writes `frames` as an animated PNG that goes on for ever to `path`."""
    with replace_file(path) as temporary:
        timing = {"duration": 1000 * SECONDS / len(frames), "loop": 0}
        temporary.write_bytes(encode(frames, ".png", **timing))
