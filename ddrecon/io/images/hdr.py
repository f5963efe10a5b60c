"""Radiance pictures, .hdr: 8-bit mantissas that share an exponent, in flat or run-length encoded
scanlines.

The format of Ward, *Real Pixels*, Graphics Gems II (1991), and of the Radiance file format page. A
byte m under exponent e stands for m 2^(e - 136), as in Walter's widely copied rgbe.c. Scanlines are
decoded one by one, so memory is taken only for what the file holds.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import check_size

MAX_HEADER = 65536
MAX_SIDE = 65536
_BEGINNING = re.compile(rb"(.*?)\n\r?\n([^\n]*)\n", re.DOTALL)
_SIZE = re.compile(rb"([-+])([XY]) +(\d{1,9}) +([-+])([XY]) +(\d{1,9})\s*")


@dataclass(frozen=True)
class _Layout:
    """How `lines` scanlines of `length` pixels are laid out: along x or y, and from which side."""

    lines: int
    length: int
    is_upright: bool
    are_lines_flipped: bool
    are_pixels_flipped: bool

    def arranged(self, pixels: np.ndarray) -> np.ndarray:
        """`pixels` [lines, length, 3] as an image whose row 0 is the top and column 0 the left."""
        pixels = pixels[::-1] if self.are_lines_flipped else pixels
        pixels = pixels[:, ::-1] if self.are_pixels_flipped else pixels
        return np.ascontiguousarray(pixels if self.is_upright else pixels.swapaxes(0, 1))


def read_hdr(path: Path) -> np.ndarray:
    """The pixels of the file at `path`, float32 [h, w, 3], exposure divided out; raises FormatError
    when it cannot be used.
    """
    check_size(path.stat().st_size, path, "the image")
    data = path.read_bytes()
    if not data.startswith(b"#?"):
        raise FormatError(path, "not a Radiance picture: it does not begin with #?")
    match = _BEGINNING.match(data[:MAX_HEADER])
    if match is None:
        raise FormatError(path, "is damaged: its header does not end")
    exposure, layout = _exposure(match[1], path), _layout(match[2], path)
    lines = _scanlines(data, match.end(), layout, path)
    with np.errstate(over="ignore"):
        return layout.arranged((_radiance(lines) / exposure).astype(np.float32))


def _exposure(header: bytes, path: Path) -> np.ndarray:
    """What the stored values were multiplied by, [1] or [3]; raises FormatError when they are not
    red, green and blue.
    """
    factor = np.ones(1)
    for line in header.splitlines()[1:]:
        name, _, value = (part.strip() for part in line.partition(b"="))
        if name == b"FORMAT" and value != b"32-bit_rle_rgbe":
            raise FormatError(
                path,
                f"holds pixels of format {value.decode(errors='replace')!r}; save it as 32-bit_rle_rgbe, or as .exr",
            )
        if name in (b"EXPOSURE", b"COLORCORR"):
            factor = factor * _positive(value, 1 if name == b"EXPOSURE" else 3, path)
    return factor


def _positive(text: bytes, count: int, path: Path) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not (np.isfinite(values) & (values > 0)).all():
        raise FormatError(
            path,
            f"is damaged: {text.decode(errors='replace')!r} is no exposure or color correction",
        )
    return values


def _layout(text: bytes, path: Path) -> _Layout:
    match = _SIZE.fullmatch(text)
    if match is None or match[2] == match[5]:
        raise FormatError(
            path,
            f"is damaged: {text[:40].decode(errors='replace')!r} is no size such as '-Y 512 +X 1024'",
        )
    lines, length = int(match[3]), int(match[6])
    if not (0 < lines <= MAX_SIDE and 0 < length <= MAX_SIDE):
        raise FormatError(
            path, f"has {lines} scanlines of {length} pixels; 1 to {MAX_SIDE} of each are read"
        )
    check_size(12 * lines * length, path, f"an image of {lines} scanlines of {length} pixels")
    flips = {
        axis: sign != {b"Y": b"-", b"X": b"+"}[axis]
        for sign, axis in ((match[1], match[2]), (match[4], match[5]))
    }
    return _Layout(lines, length, match[2] == b"Y", flips[match[2]], flips[match[5]])


def _scanlines(data: bytes, position: int, layout: _Layout, path: Path) -> np.ndarray:
    """The stored bytes uint8 [lines, length, 4] that begin at `position` in `data`."""
    rows = []
    for number in range(layout.lines):
        try:
            row, position = _scanline(data, position, layout.length)
        except ValueError as error:
            raise FormatError(
                path, f"is damaged: scanline {number} of {layout.lines} {error}"
            ) from error
        rows.append(row)
    return np.stack(rows)


def _scanline(data: bytes, position: int, length: int) -> tuple[np.ndarray, int]:
    """One scanline uint8 [length, 4], and where the next begins; raises ValueError when it is
    damaged.
    """
    start = data[position : position + 4]
    is_encoded = 8 <= length < 32768 and start[:2] == b"\2\2" and len(start) == 4 and start[2] < 128
    if not is_encoded:
        return _old_scanline(data, position, length)
    if int.from_bytes(start[2:], "big") != length:
        raise ValueError(f"is {int.from_bytes(start[2:], 'big')} pixels long, not {length}")
    planes = bytearray()
    position += 4
    for plane in range(1, 5):
        position = _unpack(data, position, planes, plane * length)
    return np.frombuffer(bytes(planes), np.uint8).reshape(4, length).T, position


def _unpack(data: bytes, position: int, planes: bytearray, end: int) -> int:
    """Appends runs and literal bytes to `planes` until it is `end` long; returns where it stopped
    reading.
    """
    while len(planes) < end:
        head = data[position : position + 2]
        if len(head) < 2:
            raise ValueError("ends too early")
        count, is_run = (head[0] - 128, True) if head[0] > 128 else (head[0], False)
        if not 0 < count <= end - len(planes):
            raise ValueError("has a run that does not fit")
        piece = head[1:] * count if is_run else data[position + 1 : position + 1 + count]
        if len(piece) < count:
            raise ValueError("ends too early")
        planes += piece
        position += 2 if is_run else 1 + count
    return position


def _old_scanline(data: bytes, position: int, length: int) -> tuple[np.ndarray, int]:
    """A scanline of flat pixels, or of pixels repeated by (1, 1, 1, n) n times; of several in a
    row, each counts 256 times the last.
    """
    chunk = data[position : position + 8 * length]
    if len(chunk) < 4:
        raise ValueError("ends too early")
    pixels = np.frombuffer(chunk, np.uint8, len(chunk) // 4 * 4).reshape(-1, 4)
    is_run = (pixels[:, :3] == 1).all(axis=1)
    if len(pixels) >= length and not is_run[:length].any():
        return pixels[:length], position + 4 * length
    index = np.arange(len(pixels))
    origin = np.maximum.accumulate(np.where(is_run, -1, index))
    counts = np.where(
        is_run, pixels[:, 3].astype(np.int64) << 8 * np.clip(index - origin - 1, 0, 4), 1
    )
    used = int(np.searchsorted(np.cumsum(counts), length)) + 1
    if used > len(pixels):
        raise ValueError("ends too early")
    if origin[0] < 0 or counts[:used].sum() != length:
        raise ValueError("has a run that does not fit")
    return np.repeat(pixels[origin[:used]], counts[:used], axis=0), position + 4 * used


def _radiance(stored: np.ndarray) -> np.ndarray:
    """Linear values of `stored` uint8 [..., 4]: mantissas times 2^(exponent - 136), black where the
    exponent is 0.
    """
    exponent = stored[..., 3:].astype(np.int32)
    return np.ldexp(
        stored[..., :3].astype(np.float32), np.where(exponent > 0, exponent - 136, -1000)
    )
