"""Float TIFF images, gray, RGB or RGBA: read through `tifffile` (extra `tiff`), written without.

What is written is the baseline of TIFF 6.0 (Adobe, 1992): one strip of uncompressed 32-bit floats.
imageio alone writes no float colors, and this much needs no package.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.extras import load_for_file
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.files.reading import guard_reading

MARK = "bounds"
"""What the description of a stack that we wrote says, besides what ImageJ says."""
HEADER = struct.Struct("<2sHI")
WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, OFFSETS = 256, 257, 258, 259, 262, 273
ORIENTATION, SAMPLES, ROWS, COUNTS, PLANAR, SAMPLE_FORMAT = 274, 277, 278, 279, 284, 339
UNCOMPRESSED = INTERLEAVED = BLACK_IS_ZERO = TOP_LEFT = 1
RGB, FLOAT = 2, 3


def write_tiff(path: Path, pixels: np.ndarray) -> None:
    """Writes `pixels` [h, w], [h, w, 3] or [h, w, 4] as one strip of little-endian float32."""
    height, width = pixels.shape[:2]
    samples = 1 if pixels.ndim == 2 else pixels.shape[2]
    data = np.ascontiguousarray(pixels, "<f4").tobytes()
    tags = {
        WIDTH: [width],
        HEIGHT: [height],
        BITS: [32] * samples,
        COMPRESSION: [UNCOMPRESSED],
        PHOTOMETRIC: [BLACK_IS_ZERO if samples == 1 else RGB],
        OFFSETS: [HEADER.size],
        SAMPLES: [samples],
        ROWS: [height],
        COUNTS: [len(data)],
        PLANAR: [INTERLEAVED],
        SAMPLE_FORMAT: [FLOAT] * samples,
    }
    end = HEADER.size + len(data)
    with replace_file(path) as temporary:
        temporary.write_bytes(HEADER.pack(b"II", 42, end) + data + _directory(tags, end))


def _directory(tags: dict[int, list[int]], start: int) -> bytes:
    """The `tags`, all of 32-bit numbers, as the last directory of a file, for the place `start`."""
    entries, overflow = b"", b""
    overflow_start = start + 2 + 12 * len(tags) + 4
    for tag, values in sorted(tags.items()):
        packed = struct.pack(f"<{len(values)}I", *values)
        if len(packed) > 4:  # an entry has room for one number, or for where several stand
            packed, overflow = struct.pack("<I", overflow_start + len(overflow)), overflow + packed
        entries += struct.pack("<HHI", tag, 4, len(values)) + packed
    return struct.pack("<H", len(tags)) + entries + bytes(4) + overflow


def read_tiff(path: Path) -> np.ndarray:
    """The pixels of the TIFF file at `path`, float32 [h, w] or [h, w, samples].

    Raises FormatError for a volume (several pages), and where pixels are not floats, or are laid
    out otherwise than from the top left.
    """
    with open_tiff(path) as file:
        if _is_stack(file):
            raise FormatError(path, "is a volume (several pages); an image is a single page")
        page = file.pages[0]
        if reason := _unsupported(page):
            raise FormatError(
                path, f"{reason}; only float TIFF, gray or RGB, is read: save it so, or as .exr"
            )
        check_size(page.size * page.dtype.itemsize, path, "the image")
        if 0 in page.databytecounts:
            raise FormatError(path, "is damaged: some of its pixels are not there")
        pixels = as_float32(page.asarray())
        return np.moveaxis(pixels, 0, 2) if page.axes == "SYX" else pixels


def is_stack(path: Path) -> bool:
    """Whether the TIFF file at `path` is a volume: of several pages, or written as one by us."""
    with guard_reading(path), open_tiff(path) as file:
        return _is_stack(file)


@contextmanager
def open_tiff(path: Path) -> Iterator[Any]:
    """The `tifffile.TiffFile` at `path`, for a block that reads it.

    Raises FormatError for damage that tifffile only logs: it takes the pages before a cut for all.
    """
    tifffile = load_for_file("tifffile", path)
    errors: list[str] = []

    def keep_errors(record: logging.LogRecord) -> bool:
        if record.levelno >= logging.ERROR:
            errors.append(record.getMessage())
        return False

    logger = logging.getLogger("tifffile")
    logger.addFilter(keep_errors)
    try:
        with tifffile.TiffFile(path) as file:
            yield file
    except (KeyError, ValueError) as error:
        if "imagecodecs" in str(error):
            raise FormatError(path, f"cannot be read: {error}; save it uncompressed") from error
        raise
    finally:
        logger.removeFilter(keep_errors)
    if errors:
        raise FormatError(path, f"is damaged: {errors[0]}")


def _is_stack(file: Any) -> bool:
    facts = file.imagej_metadata or {}
    return len(file.pages) > 1 or facts.get("images", 1) > 1 or MARK in facts


def _unsupported(page: Any) -> str | None:
    """What keeps `page`, of tifffile, from being an image of ours; None where nothing does."""
    orientation = page.tags[ORIENTATION].value if ORIENTATION in page.tags else TOP_LEFT
    if orientation != TOP_LEFT:
        return "has turned rows"
    if page.dtype is None or page.dtype.kind != "f":
        return f"holds {page.bitspersample}-bit samples of format {int(page.sampleformat)}"
    if page.photometric not in (BLACK_IS_ZERO, RGB):
        return f"has photometric interpretation {int(page.photometric)}"
    return None if page.axes in ("YX", "YXS", "SYX") else f"has the axes {page.axes}"
