"""OpenVDB files of any kind, encoded from dictionaries of voxels by the format's description alone.

Nothing here is shared with the reader. A file has grids, a grid has leaves and tiles, and the array
that they mean is `dense`.
"""

import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

Place = tuple[int, int, int]
Array = np.ndarray
TYPES = {"half": "<f2", "float": "<f4", "double": "<f8", "vec3s": "<f4", "vec3d": "<f8"}
SIDES = {8: 1, 128: 16, 4096: 32}
"""Of tiles: voxels along a side; and how many children a node has that is so large."""


@dataclass
class Tile:
    """A cube of `side` voxels from `corner` on, all of the value [C]."""

    corner: Place
    side: int
    value: Array
    is_active: bool


@dataclass
class Grid:
    """`leaves` have values [512, C] and which are active [512], by their first voxel."""

    name: str = "density"
    kind: str = "float"
    is_half: bool = False
    flags: int = 2
    map: tuple[str, Iterable[float]] = ("UniformScaleMap", [0.5] * 15)
    labels: dict[str, str] = field(default_factory=dict)
    background: float = 0.0
    leaves: dict[Place, tuple[Array, Array]] = field(default_factory=dict)
    tiles: list[Tile] = field(default_factory=list)
    parent: str = ""
    tree: str = ""

    @property
    def components(self) -> int:
        return 3 if "vec" in self.kind else 1

    def box(self) -> tuple[Array, Array]:
        """The first active voxel and behind the last, [3] each."""
        cubes = [
            (np.array(tile.corner), np.array(tile.corner) + tile.side)
            for tile in self.tiles
            if tile.is_active
        ]
        for corner, (_, is_active) in self.leaves.items():
            where = np.argwhere(is_active.reshape(8, 8, 8)) + corner
            cubes += [(where.min(0), where.max(0) + 1)] if len(where) else []
        return np.min([low for low, _ in cubes], 0), np.max([high for _, high in cubes], 0)

    def dense(self, low: Array, high: Array) -> Array:
        """Values [x, y, z, C] of the voxels from `low` to before `high`, as float32."""
        around = np.full((*(high - low + 16), self.components), self.background, np.float64)
        for tile in self.tiles:
            a, b = np.clip([tile.corner - low + 8, tile.corner - low + 8 + tile.side], 0, None)
            around[tuple(map(slice, a, b))] = tile.value
        for corner, (values, _) in self.leaves.items():
            a = corner - low + 8
            if (a >= 0).all() and (a + 8 <= around.shape[:3]).all():
                around[tuple(map(slice, a, a + 8))] = values.reshape(8, 8, 8, -1)
        return around[8:-8, 8:-8, 8:-8].astype(np.float32)


def write_file(path: Path, *grids: Grid, version: int = 224, has_places: int = 1) -> Path:
    data = struct.pack("<qIIIB", 0x56444220, version, 9, 1, has_places)
    if version < 222:
        data += bytes([grids[0].flags & 1])
    data += b"0" * 36 + metadata({"creator": "a test"}) + struct.pack("<I", len(grids))
    for grid in grids:
        tree = grid.tree or f"Tree_{grid.kind}_5_4_3" + "_HalfFloat" * grid.is_half
        data += text(grid.name) + text(tree) + text(grid.parent)
        begin = len(data) + 24
        body = struct.pack("<I", grid.flags) if version >= 222 else b""
        body += metadata(grid.labels) + text(grid.map[0]) + np.array(grid.map[1], "<f8").tobytes()
        topology, voxels = (b"", b"") if grid.parent else Encoder(grid, version).encode()
        middle = 0 if grid.parent else begin + len(body + topology)
        end = begin + len(body + topology + voxels)
        data += struct.pack("<3q", begin, middle, end) + body + topology + voxels
    path.write_bytes(data)
    return path


class Encoder:
    def __init__(self, grid: Grid, version: int):
        self.grid, self.version = grid, version
        self.single = np.dtype(TYPES[grid.kind])
        self.stored = np.dtype("<f2") if grid.is_half else self.single
        self.background = np.full(grid.components, grid.background, self.single)

    def encode(self) -> tuple[bytes, bytes]:
        """The topology, and the voxels."""
        grid = self.grid
        tiles = [tile for tile in grid.tiles if tile.side == 4096]
        roots = sorted({parent(place, 4096) for place in grid.leaves})
        roots += [tile_root for tile_root in self.tile_roots() if tile_root not in roots]
        topology = struct.pack("<I", 1) + self.background.tobytes()
        topology += struct.pack("<II", len(tiles), len(roots))
        for tile in tiles:
            value = np.asarray(tile.value, self.single).tobytes()
            topology += struct.pack("<3i", *tile.corner) + value + bytes([tile.is_active])
        order: list[Place] = []
        for root in roots:
            topology += struct.pack("<3i", *root) + self.node(root, 4096, order)
        return topology, b"".join(map(self.leaf, order))

    def tile_roots(self) -> list[Place]:
        small = [tile for tile in self.grid.tiles if tile.side < 4096]
        return sorted({parent(tile.corner, 4096) for tile in small})

    def node(self, corner: Place, size: int, order: list[Place]) -> bytes:
        side = {4096: 128, 128: 8}[size]
        count = size // side
        values = np.tile(self.background, (count**3, 1))
        is_child, is_active = np.zeros((2, count**3), bool)
        below = [place for place in self.grid.leaves if parent(place, size) == corner]
        inner = [t for t in self.grid.tiles if t.side < size and parent(t.corner, size) == corner]
        children = {parent(place, side) for place in below}
        children |= {parent(tile.corner, side) for tile in inner if tile.side < side}

        def index(place: Place) -> int:
            x, y, z = (np.array(place) - corner) // side
            return int((x * count + y) * count + z)

        for tile in inner:
            if tile.side == side:
                values[index(tile.corner)] = tile.value
                is_active[index(tile.corner)] = tile.is_active
        for child in children:
            values[index(child)], is_child[index(child)] = 0, True
        data = bits(is_child) + bits(is_active)
        if self.version < 222:
            data += self.many(values[~is_child])
        else:
            data += self.masked(values, is_active, is_child)
        for child in sorted(children, key=index):
            if side == 8:
                data += bits(self.grid.leaves[child][1])
                order.append(child)
            else:
                data += self.node(child, side, order)
        return data

    def leaf(self, place: Place) -> bytes:
        values, is_active = self.grid.leaves[place]
        data = bits(is_active)
        values = values.astype(self.single)
        if self.version < 222:
            extra = self.many(values[::-1])
            return data + struct.pack("<3ib", *place, 2) + self.many(values) + extra
        return data + self.masked(values, is_active, np.zeros(512, bool))

    def masked(self, values: Array, is_active: Array, is_child: Array) -> bytes:
        """A code, what it says of inactive values, then the values that are left."""
        if not self.grid.flags & 2:
            return b"\6" + self.many(values)
        background, inactive = self.background, values[~is_active & ~is_child]
        kinds = list(np.unique(inactive, axis=0))
        others = [row for row in kinds if not (row == background).all()]
        is_some = len(others) < len(kinds)
        code, singles, second = 6, others, background
        if len(kinds) <= 2:
            is_minus = len(others) == 1 and bool((others[0] == -background).all())
            code = {0: 0, 1: 4 if is_some else 2, 2: 5}[len(others)]
            if is_minus:
                code, singles = 3 if is_some else 1, []
            second = others[1] if len(others) == 2 else background
        if code == 6:
            return b"\6" + self.many(values)
        data = bytes([code]) + b"".join(row.tobytes() for row in singles)
        if code in (3, 4, 5):
            data += bits((values == second).all(1) & ~is_active)
        return data + self.many(values[is_active])

    def many(self, values: Array) -> bytes:
        data = values.astype(self.stored).tobytes()
        if not self.grid.flags & 5 or (self.grid.is_half and not len(values)):
            return data
        if self.grid.flags & 4:
            # As OpenVDB does, of LZ4, numbers of four bytes whatever they are.
            blosc = pytest.importorskip("blosc", reason="no blosc (extra `vdb`)")
            packed = blosc.compress(data, typesize=4, cname="lz4") if data else b""
        else:
            packed = zlib.compress(data)
        if len(packed) >= len(data):
            return struct.pack("<q", -len(data)) + data
        return struct.pack("<q", len(packed)) + packed


def parent(place: Place, side: int) -> Place:
    x, y, z = (at // side * side for at in place)
    return x, y, z


def bits(is_on: Array) -> bytes:
    return np.packbits(is_on, bitorder="little").tobytes()


def text(words: str) -> bytes:
    return struct.pack("<I", len(words.encode())) + words.encode()


def metadata(entries: dict[str, str]) -> bytes:
    records = [text(name) + text("string") + text(value) for name, value in entries.items()]
    return struct.pack("<I", len(records)) + b"".join(records)
