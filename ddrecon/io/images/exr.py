"""OpenEXR images, through the `OpenEXR` module of the extra `exr`. Linear; alpha, where present, is
premultiplied by convention.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.extras import load_for_file
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file


def has_exr() -> bool:
    """Whether OpenEXR is installed."""
    try:
        import OpenEXR  # noqa: F401
    except ImportError:
        return False
    return True


def read_exr(path: Path) -> np.ndarray:
    """The pixels of the file at `path`: float32 [h, w], [h, w, 3] or [h, w, 4]; raises FormatError
    when it cannot be used.
    """
    module = load_for_file("OpenEXR", path)
    try:
        _check_window(module.File(str(path), header_only=True).header(), path)
        channels = {
            name: channel.pixels
            for name, channel in module.File(str(path), separate_channels=True).channels().items()
        }
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise FormatError(path, f"not a complete OpenEXR image: {error}") from error
    planes = [as_float32(channels[name]) for name in _chosen(list(channels), path)]
    return planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)


def write_exr(path: Path, pixels: np.ndarray) -> None:
    """Writes `pixels` [h, w, 3] as float32 RGB; raises FormatError where OpenEXR is not installed."""
    module = load_for_file("OpenEXR", path)
    header = {"compression": module.ZIP_COMPRESSION, "type": module.scanlineimage}
    with replace_file(path) as temporary:
        module.File(header, {"RGB": as_float32(pixels)}).write(str(temporary))


def _check_window(header: dict[str, tuple[np.ndarray, np.ndarray]], path: Path) -> None:
    (low, high), display = header["dataWindow"], header["displayWindow"]
    if not (np.array_equal(low, display[0]) and np.array_equal(high, display[1])):
        raise FormatError(path, "its data window is not its display window; save it uncropped")
    width, height = (int(side) + 1 for side in high - low)
    check_size(16 * width * height, path, f"an image of {width} x {height} pixels")


def _chosen(names: list[str], path: Path) -> list[str]:
    if {"R", "G", "B"} <= set(names):
        return ["R", "G", "B", "A"] if "A" in names else ["R", "G", "B"]
    if len(names) == 1:
        return names
    if set(names) == {"Y", "A"}:
        return ["Y", "Y", "Y", "A"]
    raise FormatError(
        path,
        f"has the channels {', '.join(names)}; expected R, G, B, optionally A, or a single one",
    )
