"""Trees of OpenVDB files: root, upper nodes (32³ children), lower nodes (16³), leaves (8³).

A file has the topology of a tree first: each node before its children, with the values of its
tiles, which are children that are the same all over; of leaves, which voxels are active. Then it
has the voxels, leaf by leaf. Indices run as OpenVDB's do, z fastest.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ddrecon.errors import FormatError

LEAF, LOWER, UPPER = 3, 4, 5
"""Log2 of the children along an axis, of a leaf and the nodes above: OpenVDB's standard tree."""
SIDE, VOXELS = 2**LEAF, 2 ** (3 * LEAF)
"""Voxels of a leaf: along a side, and in all."""
ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4
"""How values are compressed, flags of a grid."""
NODE_MASKS = 222
"""The version of files since which nodes say what is left out of their values."""
ALL_VALUES = 6
"""What such a node says that leaves nothing out."""
NOWHERE = np.array([[2**40] * 3, [-(2**40)] * 3])
"""A box that holds nothing."""
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


class Coding(NamedTuple):
    """How the values of a tree are stored: in a file of `version`, compressed as `flags` say.

    A value has `components` numbers, of the type `stored` where there are many, and `single` where
    a value stands alone.
    """

    version: int
    flags: int
    stored: np.dtype
    single: np.dtype
    components: int


class Nodes(NamedTuple):
    """Cubes of `side` voxels from `corners` [n, 3] on: tiles of `values` [n, C], or leaves without.

    `is_active` is [n] for tiles, and for leaves [n, 512].
    """

    corners: np.ndarray
    side: int
    is_active: np.ndarray
    values: np.ndarray | None = None

    def measure(self) -> np.ndarray:
        """The box [2, 3] of what is active, from its first voxels to behind its last."""
        is_some = self.is_active if self.is_active.ndim == 1 else self.is_active.any(1)
        corners = self.corners[is_some]
        ends = corners + self.side
        if self.values is None:
            blocks = self.is_active[is_some].reshape(-1, SIDE, SIDE, SIDE)
            along = [np.asarray(blocks.any(others)) for others in ((2, 3), (1, 3), (1, 2))]
            ends = ends - np.stack([active[:, ::-1].argmax(1) for active in along], 1)
            corners = corners + np.stack([active.argmax(1) for active in along], 1)
        return np.stack([corners.min(0), ends.max(0)]) if len(corners) else NOWHERE


def join(box: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The smallest box [2, 3] around both."""
    return np.stack([np.minimum(box[0], other[0]), np.maximum(box[1], other[1])])


class Tree:
    """The tree at the place `begin` of `stream`, whose values are stored by `coding`."""

    def __init__(self, stream: Stream, coding: Coding, begin: int):
        self.stream, self.coding = stream, coding
        stream.at = begin
        if stream.unpack("<I") != (1,):
            raise ValueError("a tree has several buffers")
        (self.background,) = self.read_singles(1)
        self.begin = stream.at

    def read_singles(self, count: int) -> np.ndarray:
        """The next `count` values that stand alone, [count, C]."""
        components = self.coding.components
        return self.stream.array(self.coding.single, count * components).reshape(count, components)

    def read_many(self, count: int) -> np.ndarray:
        """The next `count` values, [count, C]."""
        stream, (_, flags, stored, single, components) = self.stream, self.coding
        size = count * components * stored.itemsize
        if not flags & (ZIP | BLOSC):
            data = stream.read(size)
        elif not count and stored != single:
            data = b""  # of no halves there is not even a length
        else:
            (packed,) = stream.unpack("<q")
            data = stream.read(abs(packed))
            if packed > 0 and flags & BLOSC:
                data = unpack_blosc(stream.path, data, size)
            elif packed > 0:
                data = zlib.decompressobj().decompress(data, size + 1)  # no more, of a bomb
        if len(data) != size:
            raise ValueError(f"values of {size} bytes have {len(data)}")
        return np.frombuffer(data, stored).reshape(count, components)

    def read_masked(self, is_active: np.ndarray) -> np.ndarray:
        """The next values of a node or leaf, [n, C]; those that are not active may be left out.

        Then they are one of two values, which a mask selects.
        """
        count, code = len(is_active), ALL_VALUES
        if self.coding.version >= NODE_MASKS:
            (code,) = self.stream.unpack("<B")
        if code > ALL_VALUES:
            raise ValueError(f"a node has the code {code}")
        choices = np.stack([self.background if code == 0 else -self.background, self.background])
        singles = {2: 1, 4: 1, 5: 2}.get(code, 0)
        choices[:singles] = self.read_singles(singles)
        selected = self.stream.bits(count).astype(int) if code in (3, 4, 5) else 0
        if code == ALL_VALUES or not self.coding.flags & ACTIVE_MASK:
            return self.read_many(count)
        values = np.empty((count, self.coding.components), self.coding.single)
        values[:] = choices[selected]
        values[is_active] = self.read_many(int(np.count_nonzero(is_active)))
        return values

    def read_topology(self) -> Iterator[Nodes]:
        """All tiles that are active or no background, and all leaves, in the order of voxels.

        Whoever takes them leaves the place in the stream alone.
        """
        stream, components = self.stream, self.coding.components
        stream.at = self.begin
        tiles, roots = stream.unpack("<II")
        layout = [("corner", "<i4", 3), ("value", self.coding.single, (components,))]
        table = stream.array(np.dtype([*layout, ("is_active", "u1")]), tiles)
        values, side = table["value"].reshape(tiles, components), SIDE << LOWER + UPPER
        yield Nodes(table["corner"].astype(int), side, table["is_active"] > 0, values)
        for _ in range(roots):
            yield from self.read_node(np.array(stream.unpack("<3i")), UPPER, LOWER, LEAF)

    def read_node(self, corner: np.ndarray, size: int, *below: int) -> Iterator[Nodes]:
        """The next node, from `corner` on: 2^`size` children along an axis, those of 2^`below`."""
        stream, count, side = self.stream, 2 ** (3 * size), 2 ** sum(below)
        is_child, is_active = stream.bits(count), stream.bits(count)
        if self.coding.version < NODE_MASKS:
            values = np.empty((count, self.coding.components), self.coding.stored)
            values[~is_child] = self.read_masked(is_active[~is_child])
        else:
            values = self.read_masked(is_active)
        is_tile = ~is_child & (is_active | (values != self.background).any(1))
        corners = corner + side * np.indices([2**size] * 3).reshape(3, -1).T
        yield Nodes(corners[is_tile], side, is_active[is_tile], values[is_tile])
        children = corners[is_child]
        if len(below) == 1:
            yield Nodes(children, side, stream.bits(VOXELS * len(children)).reshape(-1, VOXELS))
        else:
            for child in children:
                yield from self.read_node(child, *below)

    def measure(self) -> np.ndarray:
        """The box [2, 3] of active voxels, as `Nodes.measure`."""
        return reduce(join, (nodes.measure() for nodes in self.read_topology()), NOWHERE)

    def fill(self, values: np.ndarray, low: np.ndarray) -> None:
        """Writes the tree's values to `values` [x, y, z, C], the voxels from the index `low` on."""
        values[:] = self.background
        leaves = list[list[int]]()
        for nodes in self.read_topology():
            starts = (nodes.corners - low).tolist()
            if nodes.values is None:
                leaves += starts
                continue
            for start, value in zip(starts, nodes.values, strict=True):
                values[_overlap(start, nodes.side, values.shape)[0]] = value
        for start in leaves:
            is_active, buffers = self.stream.bits(VOXELS), 1
            if self.coding.version < NODE_MASKS:
                *_, buffers = self.stream.unpack("<3ib")
            block = self.read_masked(is_active).reshape(SIDE, SIDE, SIDE, -1)
            place, inside = _overlap(start, SIDE, values.shape)
            values[place] = block[inside]
            for _ in range(buffers - 1):  # of a simulation, of which the first counts
                self.read_many(VOXELS)


def _overlap(start: list[int], side: int, shape: tuple[int, ...]) -> tuple[Any, Any]:
    """Where a cube of `side` voxels from `start` on meets an array of `shape`: there, and in it."""
    place, inside = [], []
    for first, size in zip(start, shape, strict=False):
        low = max(first, 0)
        high = max(low, min(first + side, size))
        place.append(slice(low, high))
        inside.append(slice(low - first, high - first))
    return tuple(place), tuple(inside)


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
