"""Colors of 16 bits from PNG files, which Pillow, and so imageio, cuts to 8.

Only what Pillow does not do: 16 bits of gray with alpha, RGB or RGBA, not interlaced
(PNG Specification, third edition, W3C 2025).
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
LEFT, ABOVE, MEAN, PAETH = 1, 2, 3, 4
"""The filters of rows, by what predicts a byte; 0 is none."""
BAND = 512
"""Rows that are unfiltered at a time; the arrays that takes have BAND + width lines of BAND."""
HEADER = struct.Struct(">IIBBBBB")


def has_deep_colors(path: Path) -> bool:
    """Whether the file at `path` is a PNG of several channels of 16 bits."""
    head = _head(path)
    return is_deep_png(path) and head[25] in CHANNELS


def is_deep_png(path: Path) -> bool:
    """Whether the file at `path` is a PNG of 16 bits a channel."""
    head = _head(path)
    return head[:8] == MAGIC and len(head) == 26 and head[24] == 16


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(26)


def read_deep_png(path: Path) -> np.ndarray:
    """The stored values of such a file, uint16 [h, w, channels].

    Raises FormatError when it is damaged or interlaced.
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
    if filtered[:, 0].max() > PAETH:
        raise FormatError(path, f"is damaged: there is no filter of type {filtered[:, 0].max()}")
    pixels = _unfilter(filtered[:, 0], filtered[:, 1:].reshape(height, width, -1))
    return pixels.view(">u2").astype(np.uint16)


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of each chunk up to the last.

    Raises struct.error or zlib.error where one is cut short or changed.
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
    """The bytes [h, w, b] of pixels; `stored` [h, w, b] is what they are less a prediction.

    `filters` [h] says how each row is predicted.
    """
    known = np.zeros((len(stored) + 1, *stored.shape[1:]), np.uint8)
    for top in range(0, len(stored), BAND):
        band = slice(top, top + BAND)
        known[1:][band] = _unfilter_band(filters[band], stored[band], known[top])
    return known[1:]


def _unfilter_band(filters: np.ndarray, stored: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """The same for some rows, of which the one before is `previous` [w, b].

    A byte x is predicted from c, b and a: from the pixels above left, above and left of it.

        c b        row    0 1 2 3 4    The pixels of one antidiagonal, of equal row + column as
        a x         |     1 2 3 4 5    numbered here, depend on the two before it only, and not
                    v     2 3 4 5 6    on each other: so they are all found at once.

    For that arrays are skewed, [row + column, row, b], so that an antidiagonal is a line of theirs.
    `known` also has the row and the column before the first; with x on the antidiagonal `line`,

                             row   1 + row
        known[line]           c
        known[line + 1]       b       a
        known[line + 2]               x
    """
    height, width, depth = stored.shape
    differences = np.zeros((height + width - 1, height, depth), np.int16)
    known = np.zeros((height + width + 1, height + 1, depth), np.int16)
    _unskew(differences, height, width)[:] = stored
    known[1 : width + 1, 0] = previous
    is_left, is_above, is_mean, is_paeth = (
        (filters[:, None] == kind).astype(np.int16) for kind in (LEFT, ABOVE, MEAN, PAETH)
    )
    for line in range(height + width - 1):
        # The rows that this antidiagonal crosses: column = line - row is within the image.
        rows = slice(max(0, line - width + 1), min(height, line + 1))
        left = known[line + 1, 1:][rows]
        above = known[line + 1, :-1][rows]
        corner = known[line, :-1][rows]
        # Each row counts the one prediction that is its filter's.
        guess = is_left[rows] * left
        guess += is_above[rows] * above
        guess += is_mean[rows] * ((left + above) >> 1)
        guess += is_paeth[rows] * _paeth(left, above, corner)
        # Bytes are stored modulo 256.
        known[line + 2, 1:][rows] = (differences[line, rows] + guess) & 255
    return _unskew(known[2:, 1:], height, width).astype(np.uint8)


def _unskew(skewed: np.ndarray, height: int, width: int) -> np.ndarray:
    """A view of `skewed` [row + column, row, b] as [row, column, b]."""
    line, row, byte = skewed.strides
    # One row on is one line and one row on in `skewed`; one column on is one line on.
    return np.lib.stride_tricks.as_strided(
        skewed, (height, width, skewed.shape[2]), (line + row, line, byte)
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
