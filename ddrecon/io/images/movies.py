"""Moving pictures as animated PNG, and MP4 (an extra); pictures within pages as WebP.

Frames and images are 8-bit sRGB, uint8 [n, h, w, 3] and [h, w, 3].
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.extras import load_extra
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


def require_mp4() -> None:
    """Raises MissingExtraError where no encoder for MP4 is installed."""
    load_extra("imageio_ffmpeg", "MP4")


def write_mp4(path: Path, frames: np.ndarray) -> None:
    """Writes `frames` as H.264 in MP4; raises MissingExtraError.

    H.264 takes even sizes only: a last odd row or column is repeated.
    """
    import imageio.v3 as iio

    require_mp4()
    height, width = frames.shape[1:3]
    even = np.pad(frames, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    with replace_file(path) as temporary:
        rate = len(frames) / SECONDS
        iio.imwrite(
            temporary, even, plugin="FFMPEG", extension=".mp4", fps=rate, macro_block_size=2
        )
