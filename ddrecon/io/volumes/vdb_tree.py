"""Trees of OpenVDB files: root, upper nodes (32³ children), lower nodes (16³), leaves (8³).

A file has the topology of a tree first: each node before its children, with the values of its
tiles, which are children that are the same all over; of leaves, which voxels are active. Then it
has the voxels, leaf by leaf. Indices run as OpenVDB's do, z fastest.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.io.files.arrays import check_size
from ddrecon.io.volumes.blosc import unpack_blosc

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


class Stream:
    """The bytes of the file at `path`, from the place `at` on; ValueError where they end."""

    def __init__(self, path: Path):
        check_size(path.stat().st_size, path, "the file")
        self.path, self.data, self.at = path, path.read_bytes(), 0

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


@dataclass(frozen=True)
class Coding:
    """How the values of a tree are stored: in a file of `version`, compressed as `flags` say.

    A value has `components` numbers, of the type `stored` where there are many, and `single` where
    a value stands alone.
    """

    version: int
    flags: int
    stored: np.dtype
    single: np.dtype
    components: int


@dataclass(frozen=True)
class Nodes:
    """Cubes of `side` voxels from `corners` [n, 3] on: tiles of `values` [n, C], or leaves without.

    `is_active` is [n] for tiles, and for leaves [n, 512].
    """

    corners: np.ndarray
    side: int
    is_active: np.ndarray
    values: np.ndarray | None = None

    def measure(self) -> np.ndarray:
        """The box [2, 3] of what is active, from its first voxels to behind its last.

        Without any, the first are behind the last.
        """
        is_some = self.is_active if self.is_active.ndim == 1 else self.is_active.any(1)
        corners, ends = self.corners[is_some], self.corners[is_some] + self.side
        if self.values is None:
            blocks = self.is_active[is_some].reshape(-1, SIDE, SIDE, SIDE)
            starts = corners
            along = [np.asarray(blocks.any(others)) for others in ((2, 3), (1, 3), (1, 2))]
            corners = starts + np.stack([active.argmax(1) for active in along], 1)
            ends = starts + SIDE - np.stack([active[:, ::-1].argmax(1) for active in along], 1)
        return np.stack([corners.min(0), ends.max(0)]) if len(corners) else NOWHERE


NOWHERE = np.array([[2**40] * 3, [-(2**40)] * 3])
"""A box that holds nothing."""


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
        stream, stored = self.stream, self.coding.stored
        size = count * self.coding.components * stored.itemsize
        if not self.coding.flags & (ZIP | BLOSC):
            data = stream.read(size)
        elif not count and stored != self.coding.single:
            data = b""  # of no halves there is not even a length
        else:
            (packed,) = stream.unpack("<q")
            data = stream.read(abs(packed))
            if packed > 0 and self.coding.flags & BLOSC:
                data = unpack_blosc(stream.path, data, size)
            elif packed > 0:
                data = zlib.decompressobj().decompress(data, size + 1)  # no more, of a bomb
        if len(data) != size:
            raise ValueError(f"values of {size} bytes have {len(data)}")
        return np.frombuffer(data, stored).reshape(count, self.coding.components)

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
        stream = self.stream
        stream.at = self.begin
        tiles, roots = stream.unpack("<II")
        layout = [
            ("corner", "<i4", 3),
            ("value", self.coding.single, (self.coding.components,)),
            ("is_active", "u1"),
        ]
        table = stream.array(np.dtype(layout), tiles)
        values = table["value"].reshape(tiles, self.coding.components)
        side = SIDE << LOWER + UPPER
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

        def corners_of(is_chosen: np.ndarray) -> np.ndarray:
            places = np.unravel_index(np.flatnonzero(is_chosen), [2**size] * 3)
            return corner + side * np.stack(places, 1)

        yield Nodes(corners_of(is_tile), side, is_active[is_tile], values[is_tile])
        children = corners_of(is_child)
        if len(below) == 1:
            masks = stream.bits(VOXELS * len(children)).reshape(-1, VOXELS)
            yield Nodes(children, side, masks)
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
                place, _ = _overlap(start, nodes.side, values.shape)
                values[place] = value
        for start in leaves:
            is_active, buffers = self.stream.bits(VOXELS), 1
            if self.coding.version < NODE_MASKS:
                *_, buffers = self.stream.unpack("<3ib")
            block = self.read_masked(is_active).reshape(SIDE, SIDE, SIDE, -1)
            place, inside = _overlap(start, SIDE, values.shape)
            values[place] = block[inside]
            for _ in range(buffers - 1):  # of a simulation, of which the first counts
                self.read_many(VOXELS)


def check_box(path: Path, name: str, box: np.ndarray, components: int) -> None:
    """Raises FormatError where float32 values in a `box` [2, 3] take too much memory."""
    x, y, z = (int(side) for side in box[1] - box[0])
    check_size(4 * components * x * y * z, path, f"{name}, of {x} x {y} x {z} voxels,")


def _overlap(start: list[int], side: int, shape: tuple[int, ...]) -> tuple[Any, Any]:
    """Where a cube of `side` voxels from `start` on meets an array of `shape`: there, and in it."""
    place, inside = [], []
    for first, size in zip(start, shape, strict=False):
        low = max(first, 0)
        high = max(low, min(first + side, size))
        place.append(slice(low, high))
        inside.append(slice(low - first, high - first))
    return tuple(place), tuple(inside)
