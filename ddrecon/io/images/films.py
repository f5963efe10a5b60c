"""Frames of films, through ffmpeg (extra `film`)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from ddrecon.errors import FormatError
from ddrecon.extras import load_for_file

if TYPE_CHECKING:
    import numpy as np

FILMS = {".mp4": "mov", ".mov": "mov", ".mkv": "matroska", ".webm": "matroska"}
"""What ffmpeg takes a suffix for: by itself it would go by content, and follow playlists."""
OTHER_CURVES = re.compile("arib-std-b67|smpte2084|smpte428|linear|log100|log316")
"""As ffmpeg calls them: HLG, PQ, that of cinemas, none and logarithms."""


def read_frame(path: Path, number: int = 0, time: float = 0.0) -> np.ndarray:
    """The frame `number`, counted from that at `time` [s], of the film at `path`: uint8 [h, w, 3].

    Raises FormatError where there is none, or the film is damaged.
    """
    # here, as scene files know suffixes without NumPy
    import numpy as np

    from ddrecon.io.files.arrays import check_size

    read = load_for_file("imageio_ffmpeg", path).read_frames
    asked = ["-f", FILMS[path.suffix.lower()]]
    try:
        about = next(read(path, input_params=asked))
        (width, height), rate = about["size"], about["fps"]
        if curve := OTHER_CURVES.search(about["pix_fmt"]):
            what = f"is encoded by {curve[0]}, not by a curve near sRGB's"
            raise FormatError(path, f"{what}; convert it to SDR (BT.709) first")
        number += round(time * rate)
        check_size(4 * width * height, path, f"a film of {width} x {height} pixels")
        # Half a frame early: the times of frames are rounded.
        asked += ["-xerror", "-ss", f"{max(0.0, (number - 0.5) / rate):.6f}"]
        _, *found = read(path, input_params=asked, output_params=["-frames:v", "1"])
    except (OSError, RuntimeError, ZeroDivisionError) as error:
        raise FormatError(path, "is damaged, or no film") from error
    if not found or number < 0:
        length = f"{about['duration']:g} seconds of {rate:g} frames"
        raise FormatError(path, f"has no frame {number}, counted from 0: it has {length}")
    return np.frombuffer(found[0], np.uint8).reshape(height, width, 3)
