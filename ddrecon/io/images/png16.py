"""Colors of 16 bits from PNG files, which Pillow, and so imageio, cuts to 8 (PNG Specification,
third edition, W3C 2025).

Only what Pillow does not do: 16 bits of gray with alpha, RGB or RGBA, not interlaced.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import check_size

MAGIC = b"\x89PNG\r\n\x1a\n"
CHANNELS = {2: 3, 4: 2, 6: 4}
"""How many a color type has; gray alone (0) Pillow reads in full."""
BAND = 512
HEADER = struct.Struct(">IIBBBBB")


def has_deep_colors(path: Path) -> bool:
    """Whether the file at `path` is a PNG of several channels of 16 bits."""
    with path.open("rb") as stream:
        head = stream.read(26)
    return head[:8] == MAGIC and len(head) == 26 and head[24] == 16 and head[25] in CHANNELS


def read_deep_png(path: Path) -> np.ndarray:
    """The stored values of such a file, uint16 [h, w, channels]; raises FormatError when it is
    damaged or interlaced.
    """
    try:
        chunks = list(_chunks(path.read_bytes()))
        width, height, _, color, _, _, interlace = HEADER.unpack(chunks[0][1])
        if interlace:
            raise FormatError(path, "is interlaced; save it without, or as .exr")
        row = 2 * CHANNELS[color] * width
        size = height * (1 + row)
        check_size(size, path, f"an image of {width} x {height} pixels")
        lines = zlib.decompressobj().decompress(
            b"".join(data for kind, data in chunks if kind == b"IDAT"), size
        )
    except (struct.error, zlib.error, KeyError, IndexError) as error:
        raise FormatError(path, f"not a complete PNG image: {error}") from error
    if len(lines) != size or size == 0:
        raise FormatError(path, f"is damaged: it holds {len(lines)} bytes of pixels, not {size}")
    filtered = np.frombuffer(lines, np.uint8).reshape(height, 1 + row)
    if filtered[:, 0].max() > 4:
        raise FormatError(path, f"is damaged: there is no filter of type {filtered[:, 0].max()}")
    pixels = _unfilter(filtered[:, 0], filtered[:, 1:].reshape(height, width, -1))
    return pixels.view(">u2").astype(np.uint16)


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of each chunk up to the last; raises struct.error or zlib.error where one is
    cut short or changed.
    """
    place, kind = len(MAGIC), b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, place)
        content = data[place + 8 : place + 8 + length]
        if struct.unpack_from(">I", data, place + 8 + length)[0] != zlib.crc32(kind + content):
            raise zlib.error(f"wrong checksum of chunk {kind!r}")
        place += 12 + length
        yield kind, content


def _unfilter(filters: np.ndarray, stored: np.ndarray) -> np.ndarray:
    """The bytes [h, w, b] that were stored less a prediction each, by the `filters` [h] of their
    rows; `BAND` rows at a time.
    """
    known = np.zeros((len(stored) + 1, *stored.shape[1:]), np.uint8)
    for top in range(0, len(stored), BAND):
        band = slice(top, top + BAND)
        known[1:][band] = _unfilter_band(filters[band], stored[band], known[top])
    return known[1:]


def _unfilter_band(filters: np.ndarray, stored: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """The same of rows below `previous` [w, b].

    A byte is predicted from those to its left, above, and above left, so all places of an
    antidiagonal are found at once. Arrays are skewed: their first axis is row + column, so that an
    antidiagonal, and what it follows from, are contiguous.
    """
    height, width, depth = stored.shape
    given, known = (
        np.zeros((height + width - 1, height, depth), np.int16),
        np.zeros((height + width + 1, height + 1, depth), np.int16),
    )
    _straight(given, height, width)[:] = stored
    known[1 : width + 1, 0] = previous
    is_left, is_above, is_mean, is_paeth = (
        (filters[:, None] == kind).astype(np.int16) for kind in (1, 2, 3, 4)
    )
    for line in range(height + width - 1):
        rows = slice(max(0, line - width + 1), min(height, line + 1))
        left, above, corner = (
            known[line + 1, 1:][rows],
            known[line + 1, :-1][rows],
            known[line, :-1][rows],
        )
        guess = (
            is_left[rows] * left + is_above[rows] * above + is_mean[rows] * ((left + above) >> 1)
        )
        guess += is_paeth[rows] * _paeth(left, above, corner)
        known[line + 2, 1:][rows] = (given[line, rows] + guess) & 255
    return _straight(known[2:, 1:], height, width).astype(np.uint8)


def _straight(skewed: np.ndarray, height: int, width: int) -> np.ndarray:
    """A view of `skewed` [row + column, row, b] as [row, column, b]."""
    along, row, byte = skewed.strides
    return np.lib.stride_tricks.as_strided(
        skewed, (height, width, skewed.shape[2]), (along + row, along, byte)
    )


def _paeth(left: np.ndarray, above: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Whichever of the three is closest to left + above - corner, the first where they tie."""
    by_left, by_above = np.abs(above - corner), np.abs(left - corner)
    by_corner = np.abs(left + above - 2 * corner)
    return np.where(
        (by_left <= by_above) & (by_left <= by_corner),
        left,
        np.where(by_above <= by_corner, above, corner),
    )
