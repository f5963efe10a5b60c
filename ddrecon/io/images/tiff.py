"""Float TIFF images: the baseline of TIFF 6.0 (Adobe, 1992) that holds uncompressed 32-bit float
gray, RGB or RGBA in strips.

imageio alone writes no float colors, and this much needs no library.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import check_size
from ddrecon.io.files.atomic import replace_file

MARK = "bounds"
"""What the description of a stack that we wrote says, besides what ImageJ says."""
DESCRIPTION = 270
WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, OFFSETS = 256, 257, 258, 259, 262, 273
ORIENTATION, SAMPLES, ROWS, COUNTS, PLANAR, SAMPLE_FORMAT = 274, 277, 278, 279, 284, 339
ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
BIG = (b"II+\0", b"MM\0+")
_KNOWN = {
    WIDTH,
    HEIGHT,
    BITS,
    COMPRESSION,
    PHOTOMETRIC,
    OFFSETS,
    ORIENTATION,
    SAMPLES,
    ROWS,
    COUNTS,
    PLANAR,
    SAMPLE_FORMAT,
}
_TYPES = {3: "H", 4: "I"}
_DEFAULTS = {
    COMPRESSION: (1,),
    SAMPLES: (1,),
    PLANAR: (1,),
    SAMPLE_FORMAT: (1,),
    ORIENTATION: (1,),
    BITS: (1,),
}


def write_tiff(path: Path, pixels: np.ndarray) -> None:
    """Writes `pixels` [h, w] or [h, w, 3] as one strip of little-endian float32."""
    height, width = pixels.shape[:2]
    samples = 1 if pixels.ndim == 2 else pixels.shape[2]
    data = np.ascontiguousarray(pixels, "<f4").tobytes()
    tags = {
        WIDTH: [width],
        HEIGHT: [height],
        BITS: [32] * samples,
        COMPRESSION: [1],
        PHOTOMETRIC: [1 if samples == 1 else 2],
    }
    tags |= {
        OFFSETS: [8],
        SAMPLES: [samples],
        ROWS: [height],
        COUNTS: [len(data)],
        PLANAR: [1],
        SAMPLE_FORMAT: [3] * samples,
    }
    with replace_file(path) as temporary:
        temporary.write_bytes(
            struct.pack("<2sHI", b"II", 42, 8 + len(data)) + data + _directory(tags, 8 + len(data))
        )


def _directory(tags: dict[int, list[int]], start: int) -> bytes:
    entries, overflow = b"", b""
    overflow_start = start + 2 + 12 * len(tags) + 4
    for tag, values in sorted(tags.items()):
        packed = struct.pack(f"<{len(values)}I", *values)
        if len(packed) > 4:
            packed, overflow = struct.pack("<I", overflow_start + len(overflow)), overflow + packed
        entries += struct.pack("<HHI", tag, 4, len(values)) + packed
    return struct.pack("<H", len(tags)) + entries + bytes(4) + overflow


def read_tiff(path: Path) -> np.ndarray:
    """The pixels of the TIFF file at `path`, float32 [h, w] or [h, w, samples]; raises FormatError
    for any other kind of TIFF.
    """
    if is_stack(path):
        raise FormatError(
            path,
            "is a volume (several pages) or a BigTIFF; an image is a single page of plain TIFF",
        )
    check_size(path.stat().st_size, path, "the image")
    data = path.read_bytes()
    try:
        order = ORDERS[data[:4]]
        tags = _DEFAULTS | _read_tags(data, order)
        height, width, samples = tags[HEIGHT][0], tags[WIDTH][0], tags[SAMPLES][0]
    except (KeyError, struct.error, IndexError) as error:
        raise FormatError(path, "not a TIFF file, or a damaged one") from error
    if reason := _unsupported(tags):
        raise FormatError(
            path,
            f"{reason}; only uncompressed 32-bit float TIFF, gray or RGB in strips, is read: save it so, or as .exr",
        )
    offsets, counts, size = (
        tags[OFFSETS],
        tags.get(COUNTS, (len(data),)),
        4 * height * width * samples,
    )
    strips = (
        [data[offset : offset + count] for offset, count in zip(offsets, counts, strict=False)]
        if sum(counts) <= len(data)
        else []
    )
    if sum(map(len, strips)) != size:
        raise FormatError(
            path, f"is damaged: its strips do not hold {width} x {height} x {samples} floats"
        )
    image = (
        np.frombuffer(b"".join(strips), f"{order}f4")
        .reshape(height, width, samples)
        .astype(np.float32)
    )
    return image[..., 0] if samples == 1 else image


def is_stack(path: Path) -> bool:
    """Whether the file at `path` is a TIFF of several pages, a large one (BigTIFF), or of one page
    whose description says a box.
    """
    try:
        with (
            path.open("rb") as stream,
            mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            return data[:4] in BIG or _goes_on(data)
    except (OSError, ValueError, KeyError, struct.error):
        return False


def _goes_on(data: mmap.mmap) -> bool:
    """Whether there is a page after the first, or a box in the first one's description."""
    order = ORDERS[data[:4]]
    (start,) = struct.unpack_from(f"{order}I", data, 4)
    (entries,) = struct.unpack_from(f"{order}H", data, start)
    (following,) = struct.unpack_from(f"{order}I", data, start + 2 + 12 * entries)
    tags = [
        struct.unpack_from(f"{order}HHII", data, start + 2 + 12 * index) for index in range(entries)
    ]
    texts = [data[offset : offset + count] for tag, _, count, offset in tags if tag == DESCRIPTION]
    return following != 0 or any(f"\n{MARK}=".encode() in text for text in texts)


def _read_tags(data: bytes, order: str) -> dict[int, tuple[int, ...]]:
    (start,) = struct.unpack_from(f"{order}I", data, 4)
    (entries,) = struct.unpack_from(f"{order}H", data, start)
    tags: dict[int, tuple[int, ...]] = {}
    for position in range(start + 2, start + 2 + 12 * entries, 12):
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, position)
        if tag in _KNOWN and tag not in tags and kind in _TYPES and 0 < count <= len(data):
            layout = f"{order}{count}{_TYPES[kind]}"
            inline = struct.calcsize(layout) <= 4
            offset = (
                position + 8 if inline else struct.unpack_from(f"{order}I", data, position + 8)[0]
            )
            tags[tag] = struct.unpack_from(layout, data, offset)
    return tags


def _unsupported(tags: dict[int, tuple[int, ...]]) -> str | None:
    if tags[COMPRESSION][0] != 1:
        return f"is compressed (scheme {tags[COMPRESSION][0]})"
    if OFFSETS not in tags or tags[PLANAR][0] != 1 or tags[ORIENTATION][0] != 1:
        return "has tiles, separate color planes or turned rows"
    if set(tags[SAMPLE_FORMAT]) != {3} or set(tags[BITS]) != {32}:
        return f"holds {tags[BITS][0]}-bit samples of format {tags[SAMPLE_FORMAT][0]}"
    if tags.get(PHOTOMETRIC, (2,))[0] not in (1, 2):
        return f"has photometric interpretation {tags[PHOTOMETRIC][0]}"
    return None
