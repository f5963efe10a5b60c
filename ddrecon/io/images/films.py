"""Frames of films, by the times at which they are shown, through ffmpeg (extra `film`)."""

from __future__ import annotations

import logging
import math
import re
import subprocess
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from ddrecon.errors import FormatError
from ddrecon.extras import load_extra

if TYPE_CHECKING:
    import numpy as np

FILMS = {".mp4": "mov", ".mov": "mov", ".mkv": "matroska", ".webm": "matroska"}
"""ffmpeg's format of each suffix: by itself it would go by content, and follow playlists."""
OTHER_CURVES = re.compile("arib-std-b67|smpte2084|smpte428|linear|log100|log316")
"""Curves that are refused, by ffmpeg's names: HLG, PQ, cinema, none and logarithms."""
ALPHA = re.compile(
    r"alpha_mode *: 1|Video: [^\n]*, (yuva|rgba|bgra|argb|abgr|gbrap|ya\d)", re.IGNORECASE
)
"""How ffmpeg says that a film has alpha, which some encode apart from colors."""
STREAM = ["-map", "0:V:0"]
"""The first video that is no cover."""
AHEAD = 0.5
"""Seconds before a frame from which on a film is decoded.

ffmpeg seeks by when frames are decoded, which is earlier than when they are shown.
"""


def read_frame(path: Path, number: int = 0, time: float = 0.0) -> np.ndarray:
    """The frame `number`, counted from the one nearest to `time` [s], of the film at `path`.

    It is uint8 [h, w, 3]. Raises FormatError where there is none, or the film is damaged.
    """
    times = frame_times(path)
    number += nearest_frame(times, time)
    if not 0 <= number < len(times):
        length = f"{len(times)} frames in {times[-1]:g} seconds"
        raise FormatError(path, f"has no frame {number}, counted from 0: it has {length}")
    # Between halfway from the frame before and halfway to the next, this one alone is shown.
    near = [-1.0, *times, math.inf][number : number + 3]
    low, high = ((a + b) / 2 for a, b in pairwise(near))
    for start in (max(0.0, low - AHEAD), 0.0):  # where seeking misses it, from the start
        if (frame := _decode(path, start, low, high)) is not None:
            return frame
    raise FormatError(path, f"frame {number} is damaged")


def nearest_frame(times: Sequence[float], time: float) -> int:
    """Which of the frames shown at `times` [s] that is which is nearest to `time`."""
    return min(range(len(times)), key=lambda index: abs(times[index] - time))


def write_film(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    """Writes `frames`, uint8 [h, w, 3] of sRGB, to `path` (.mp4) as H.264 of `fps` a second.

    It is BT.709 with colors of half resolution, which players take; odd sides get a line more.
    Raises FormatError without ffmpeg.
    """
    import numpy as np

    from ddrecon.io.files.atomic import replace_file

    height, width = frames[0].shape[:2]
    to_yuv = ["-vf", "scale=out_color_matrix=bt709:out_range=tv", "-crf", "16"]
    tags = ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"]
    write = load_extra("imageio_ffmpeg", path).write_frames
    with replace_file(path) as temporary:
        stream = write(
            temporary,
            (width + width % 2, height + height % 2),
            fps=fps,
            quality=None,
            macro_block_size=1,
            output_params=[*to_yuv, *tags, "-color_range", "tv", "-f", "mp4"],
        )
        stream.send(None)
        for frame in frames:
            padded = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge")
            stream.send(np.ascontiguousarray(padded))
        stream.close()


def _decode(path: Path, start: float, low: float, high: float) -> np.ndarray | None:
    """The frame shown between `low` and `high` [s], where decoding from `start` on comes by it."""
    # here, as scene files know suffixes without NumPy
    import numpy as np

    from ddrecon.io.files.reading import check_size

    read = load_extra("imageio_ffmpeg", path).read_frames
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # it tells of turned films
    options = ["-f", FILMS[path.suffix.lower()], "-xerror", "-ss", f"{start:.6f}"]
    end = f":end={high - start:.6f}" if high < math.inf else ""
    chosen = [*STREAM, "-vf", f"trim=start={low - start:.6f}{end},setpts=0", "-frames:v", "1"]
    try:
        frames = read(path, input_params=options, output_params=chosen)
        properties = next(frames)
        width, height = properties["size"]
        if curve := OTHER_CURVES.search(properties["pix_fmt"]):
            text = f"is encoded by {curve[0]}, not by a curve near sRGB's"
            raise FormatError(path, f"{text}; convert it to SDR (BT.709) first")
        check_size(4 * width * height, path, f"a film of {width} x {height} pixels")
        decoded = list(frames)
    except (OSError, RuntimeError):
        return None
    return np.frombuffer(decoded[0], np.uint8).reshape(height, width, 3) if decoded else None


def frame_times(path: Path) -> tuple[float, ...]:
    """When each frame of the film at `path` is shown, in seconds after the film's start.

    Raises FormatError where the film is damaged.
    """
    about = path.stat()
    return _frame_times(path, about.st_size, about.st_mtime_ns)


@lru_cache(maxsize=256)
def _frame_times(path: Path, *_: int) -> tuple[float, ...]:
    """Times of all frames [s], from the film's packets, without decoding."""
    program = load_extra("imageio_ffmpeg", path).get_ffmpeg_exe()
    film = [program, "-nostdin", "-f", FILMS[path.suffix.lower()], "-i", str(path), *STREAM]
    process = subprocess.run([*film, "-c", "copy", "-f", "framecrc", "-"], capture_output=True)
    listed = process.stdout.decode(errors="replace")
    base = re.search(r"^#tb 0: (\d+)/(\d+)$", listed, re.MULTILINE)
    # Packets before 0 are cut off; hidden ones have the time of the next that is shown.
    ticks = {int(word) for word in re.findall(r"^0, *-?\d+, *(\d+),", listed, re.MULTILINE)}
    if process.returncode or base is None or not ticks:
        raise FormatError(path, "is damaged, or no film")
    if ALPHA.search(process.stderr.decode(errors="replace")):
        text = "has alpha, and does not say whether its colors are multiplied by it"
        raise FormatError(path, f"{text}; save its frames as .png or .exr, or without alpha")
    return tuple(tick * int(base[1]) / int(base[2]) for tick in sorted(ticks))
