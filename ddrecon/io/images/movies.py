"""Moving pictures: animated PNG, which needs nothing more, and MP4, an extra."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ddrecon.extras import load_extra
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.images import srgb

SECONDS = 4.0
"""How long a movie takes from its first frame back to it."""


def encode_frames(frames: Sequence[np.ndarray], white: float) -> np.ndarray:
    """`frames` [h, w, 3], linear, as 8-bit sRGB [n, h, w, 3]; radiance from `white` > 0 up is
    white.
    """
    return np.stack(
        [
            np.round(255 * srgb.encode(np.clip(np.nan_to_num(frame / white), 0, 1))).astype(
                np.uint8
            )
            for frame in frames
        ]
    )


def animation_of(frames: np.ndarray) -> bytes:
    """`frames`, 8-bit [n, h, w, 3], as an animated PNG that goes on for ever."""
    import imageio.v3 as iio

    content: bytes = iio.imwrite(
        "<bytes>",
        frames,
        plugin="pillow",
        extension=".png",
        duration=1000 * SECONDS / len(frames),
        loop=0,
    )
    return content


def write_animation(path: Path, frames: np.ndarray) -> None:
    """Writes `frames`, 8-bit [n, h, w, 3], as an animated PNG to `path`."""
    with replace_file(path) as temporary:
        temporary.write_bytes(animation_of(frames))


def require_mp4() -> None:
    """Raises MissingExtraError where no encoder for MP4 is installed."""
    load_extra("imageio_ffmpeg", "MP4")


def write_mp4(path: Path, frames: np.ndarray) -> None:
    """Writes `frames`, 8-bit [n, h, w, 3], as H.264 in MP4; a last odd row or column is repeated.
    Raises MissingExtraError.
    """
    import imageio.v3 as iio

    require_mp4()
    height, width = frames.shape[1:3]
    even = np.pad(frames, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    with replace_file(path) as temporary:
        iio.imwrite(
            temporary,
            even,
            plugin="FFMPEG",
            extension=".mp4",
            fps=len(frames) / SECONDS,
            macro_block_size=2,
        )
