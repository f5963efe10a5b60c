"""Bytes of a file one after another, and chunks that Blosc 1 packed."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError

CODECS = ("BloscLZ", "LZ4", "Snappy", "zlib", "Zstandard")
IS_SHUFFLED, IS_STORED, IS_SHUFFLED_BY_BITS, IS_WHOLE = 1, 2, 4, 16
"""Flags of Blosc."""
MOST_STREAMS, LEAST_STREAM = 16, 128
"""Blosc splits blocks into so many streams at most, of so many bytes at least."""


class Stream:
    """The bytes `data` of the file at `path`, from the place `at` on; ValueError where they end."""

    def __init__(self, path: Path, data: bytes, at: int = 0):
        self.path, self.data, self.at = path, data, at

    def read(self, count: int) -> bytes:
        start, self.at = self.at, self.at + count
        if not 0 <= start <= self.at <= len(self.data):
            raise ValueError("cut short")
        return self.data[start : self.at]

    def unpack(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(layout, self.read(struct.calcsize(layout)))

    def array(self, kind: np.dtype, count: int) -> np.ndarray:
        return np.frombuffer(self.read(kind.itemsize * count), kind)

    def text(self) -> str:
        return self.read(*self.unpack("<I")).decode()

    def metadata(self) -> dict[str, bytes]:
        """The value of each entry, by name."""
        entries = {}
        for _ in range(*self.unpack("<I")):
            name, _ = self.text(), self.text()
            entries[name] = self.read(*self.unpack("<I"))
        return entries

    def bits(self, count: int) -> np.ndarray:
        """Whether each of the next `count` is on, [count]."""
        return np.unpackbits(self.array(np.dtype(np.uint8), count // 8), bitorder="little") > 0


def unpack_blosc(path: Path, packed: bytes, size: int) -> bytes:
    """The `size` bytes in a chunk of Blosc 1, of the file at `path`: LZ4, bytes shuffled.

    A chunk has a header, then where each of its blocks begins. A block is one stream of LZ4 or,
    split, one for each byte of a number; a stream begins with its length. Before packing, the bytes
    of numbers were sorted: first the first byte of each, and so on. Raises FormatError where they
    are packed by other means, and ValueError where the chunk is damaged.
    """
    chunk = Stream(path, packed)
    flags, width, unpacked_size, block, _ = chunk.unpack("<2x2B3I")
    if unpacked_size != size or not width or not block:
        raise ValueError(f"a packed chunk of {size} bytes has {unpacked_size}")
    if flags & IS_STORED or not size:
        return packed[chunk.at : chunk.at + size]
    codec = CODECS[flags >> 5] if flags >> 5 < len(CODECS) else f"codec {flags >> 5}"
    if codec != "LZ4" or flags & IS_SHUFFLED_BY_BITS:
        order = " with bits shuffled" if flags & IS_SHUFFLED_BY_BITS else ""
        raise FormatError(path, f"is packed by Blosc's {codec}{order}; LZ4 alone is read")
    unpacked, begins = bytearray(), chunk.unpack(f"<{-(-size // block)}I")
    for start, chunk.at in zip(range(0, size, block), begins, strict=True):
        length = min(block, size - start)
        is_split = not flags & IS_WHOLE and length == block and width <= MOST_STREAMS
        streams = width if is_split and length // width >= LEAST_STREAM else 1
        data, share = bytearray(), length // streams
        for _ in range(streams):
            stream = chunk.read(*chunk.unpack("<I"))
            data += stream if len(stream) == share else unpack_lz4(stream, share)
        if len(data) != length:
            raise ValueError(f"a block of {length} bytes has {len(data)}")
        if flags & IS_SHUFFLED and width > 1:
            sorted_bytes = np.frombuffer(data, np.uint8, length // width * width)
            data[: len(sorted_bytes)] = sorted_bytes.reshape(width, -1).T.tobytes()
        unpacked += data
    return bytes(unpacked)


def unpack_lz4(packed: bytes, size: int) -> bytearray:
    """The `size` bytes of an LZ4 block; raises ValueError or IndexError where it is damaged.

    It is a row of sequences. A sequence has a token, of which half a byte is how many literals
    follow, and half how many bytes are then repeated from before; the last has literals alone.
    """
    data, at = bytearray(), 0
    while True:
        token = packed[at]
        at, count = at + 1, token >> 4
        if count == 15:
            at, count = _extend(packed, at, count)
        data += packed[at : at + count]
        at += count
        if at >= len(packed):
            break
        distance = packed[at] | packed[at + 1] << 8
        at, count = at + 2, token & 15
        if count == 15:
            at, count = _extend(packed, at, count)
        count += 4
        if not 0 < distance <= len(data) or len(data) + count > size:
            raise ValueError("a packed chunk is damaged")
        start = len(data) - distance
        # What is repeated may overlap what it makes: then it is a period.
        data += (data[start : start + count] * -(-count // distance))[:count]
    if len(data) != size:
        raise ValueError(f"a packed stream of {size} bytes has {len(data)}")
    return data


def _extend(packed: bytes, at: int, count: int) -> tuple[int, int]:
    """Where a long `count` ends that goes on at the place `at`, and how much it is."""
    while packed[at] == 255:
        at, count = at + 1, count + 255
    return at + 1, count + packed[at]
