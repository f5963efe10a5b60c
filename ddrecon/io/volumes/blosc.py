"""Chunks of Blosc 1 with LZ4 and bytes shuffled: what OpenVDB writes.

A chunk has a header, then where each of its blocks begins. A block is one stream of LZ4 or, split,
one for each byte of a number; a stream begins with its length. Before packing, the bytes of numbers
were sorted: first the first byte of each, and so on.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError

HEADER = struct.Struct("<2x2B3I")
"""Flags, bytes of a number, bytes of the unpacked chunk and of a block, and of the packed chunk."""
IS_SHUFFLED, IS_STORED, IS_SHUFFLED_BY_BITS, IS_WHOLE = 1, 2, 4, 16
LZ4 = 1
CODECS = ("BloscLZ", "LZ4", "Snappy", "zlib", "Zstandard")
MOST_STREAMS, LEAST_STREAM = 16, 128
"""Blocks are split into so many streams at most, of so many bytes at least."""


def unpack_blosc(path: Path, chunk: bytes, size: int) -> bytes:
    """The `size` bytes packed in `chunk`, of the file at `path`.

    Raises FormatError where they are packed by other means, and ValueError where it is damaged.
    """
    try:
        flags, width, unpacked_size, block, _ = HEADER.unpack_from(chunk)
        if unpacked_size != size or not width or not block:
            raise ValueError(f"a packed chunk of {size} bytes has {unpacked_size}")
        if flags & IS_STORED or not size:
            return chunk[HEADER.size : HEADER.size + size]
        codec = CODECS[flags >> 5] if flags >> 5 < len(CODECS) else f"codec {flags >> 5}"
        if codec != CODECS[LZ4] or flags & IS_SHUFFLED_BY_BITS:
            order = " with bits shuffled" if flags & IS_SHUFFLED_BY_BITS else ""
            raise FormatError(path, f"is packed by Blosc's {codec}{order}; LZ4 alone is read")
        unpacked = bytearray()
        for start in range(0, size, block):
            (at,) = struct.unpack_from("<I", chunk, HEADER.size + start // block * 4)
            length = min(block, size - start)
            is_split = not flags & IS_WHOLE and length == block and width <= MOST_STREAMS
            streams = width if is_split and length // width >= LEAST_STREAM else 1
            data = _unpack_streams(chunk, at, streams, length)
            if flags & IS_SHUFFLED and width > 1:
                sorted_bytes = np.frombuffer(data, np.uint8, length // width * width)
                data[: len(sorted_bytes)] = sorted_bytes.reshape(width, -1).T.tobytes()
            unpacked += data
        return bytes(unpacked)
    except (IndexError, struct.error) as error:
        raise ValueError("a packed chunk is cut short") from error


def _unpack_streams(chunk: bytes, at: int, streams: int, length: int) -> bytearray:
    """The `length` bytes of a block of so many `streams`, which begins at the place `at`."""
    data, share = bytearray(), length // streams
    for _ in range(streams):
        (packed,) = struct.unpack_from("<I", chunk, at)
        at += 4
        stream = chunk[at : at + packed]
        data += stream if packed == share else unpack_lz4(stream, share)
        at += packed
    if len(data) != length:
        raise ValueError(f"a block of {length} bytes has {len(data)}")
    return data


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
