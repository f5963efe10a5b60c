"""Films whose frames show their numbers, written by ffmpeg for tests to read."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

H264 = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-g", "30", "-bf", "3", "-b_strategy", "0")
"""With frames that are decoded before others that are shown earlier."""


def ffmpeg(*options: str | Path, content: bytes = b"") -> None:
    """Runs ffmpeg; the test is skipped where it is not here."""
    module = pytest.importorskip("imageio_ffmpeg", reason="films are an extra")
    said = [module.get_ffmpeg_exe(), "-v", "error", *map(str, options)]
    subprocess.run(said, input=content, check=True)


def write_film(path: Path, count: int, rate: str, *options: str, shift: str = "0") -> None:
    """Writes `count` frames, where they are of variable rate the frame `N` later by `shift`."""
    bits = np.arange(count)[:, None] >> np.arange(8) & 1
    blocks = bits.reshape(-1, 2, 4).repeat(8, 1).repeat(8, 2).astype(np.uint8) * 255
    taken = ["-f", "rawvideo", "-pix_fmt", "gray", "-s", "32x16", "-r", rate, "-i", "-"]
    later = ["-vf", f"setpts='PTS+({shift})/({rate})/TB'", "-fps_mode", "vfr"]
    ffmpeg(*taken, *(later if shift != "0" else []), *options, path, content=blocks.tobytes())


def number_of(pixels: np.ndarray) -> int:
    """The number that a frame [16, 32, 3] shows."""
    bits = pixels.reshape(2, 8, 4, 8, 3).mean((1, 3, 4)).flatten() > 0.3
    return int((bits << np.arange(8)).sum())
