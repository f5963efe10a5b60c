"""NanoVDB files (.nvdb) of float grids, as GPUs have them, read without NanoVDB.

A file is a row of segments: what its grids are, then these, packed or not. In a grid all nodes of a
size are one after another, and so an array; C++ pads them to multiples of 32 bytes.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.reading import check_size
from ddrecon.io.volumes.blosc import Stream, unpack_blosc
from ddrecon.io.volumes.field import Field
from ddrecon.io.volumes.vdb import LEAF, LOWER, SIDE, UPPER, VOXELS, Grid, Nodes, read_grid

MAGICS, VERSION = (b"NanoVDB0", b"NanoVDB2"), 32
CODECS = {1: "zip", 2: "Blosc"}
CLASSES = {1: b"level set", 3: b"staggered"}
MAP_AT, SHIFT_AT, TREE_AT = 384, 528, 672
"""Where a grid has its transform and its tree."""
CORNER = ("corner", "<i4", 3)
TILE = np.dtype([("key", "<u8"), ("child", "<i8"), ("is_active", "<u4"), ("values", "<f4", 3)])
KEY = np.array([42, 21, 0], np.uint64)
"""By how many bits a tile's key has x, y and z."""
LEAVES = np.dtype(
    [
        CORNER,
        ("", "V4"),
        ("is_active", "u1", VOXELS // 8),
        ("sums", "V16"),
        ("values", "<f4", VOXELS),
    ]
)


def _nodes(size: int) -> np.dtype:
    """Of nodes with 2^`size` children along an axis; a child's place or a tile's value is one."""
    count = 8**size
    masks = [("is_active", "u1", count // 8), ("is_child", "u1", count // 8)]
    return np.dtype([CORNER, ("", "V20"), *masks, ("sums", "V32"), ("values", "<f4", (count, 2))])


class NanoGrid(Grid):
    """A grid with a tree of NanoVDB."""

    def read_topology(self) -> Iterator[Nodes]:
        """As that of OpenVDB."""
        stream, stream.at = self.stream, self.begin
        *offsets, leaves, lower, upper = stream.unpack("<4q3I")
        stream.at = self.begin + offsets[3]
        tiles, background = stream.unpack("<24xIf32x")
        yield self.background_of(np.array([[background]], np.float32))
        table = stream.array(TILE, tiles)
        table = table[table["child"] == 0]
        corners = (table["key"][:, None] >> KEY << LEAF + LOWER + UPPER).astype("<u4").view("<i4")
        is_active, values = table["is_active"] > 0, table["values"][:, :1]
        yield Nodes(corners.astype(int), SIDE << LOWER + UPPER, is_active, values)
        for offset, count, *sizes in (
            (offsets[2], upper, UPPER, LOWER, LEAF),
            (offsets[1], lower, LOWER, LEAF),
        ):
            stream.at = self.begin + offset
            for node in stream.array(_nodes(sizes[0]), count):
                corner, values = node["corner"].astype(int) & -(2 ** sum(sizes)), node["values"]
                masks = (_bits(node[mask]) for mask in ("is_child", "is_active"))
                yield self.tiles_of(corner, *masks, values[:, :1], *sizes)
        stream.at = self.begin + offsets[0]
        nodes = stream.array(LEAVES, leaves)
        self.blocks = iter(nodes["values"])
        yield Nodes(nodes["corner"].astype(int) & -SIDE, SIDE, _bits(nodes["is_active"]))

    def read_leaf(self) -> np.ndarray:
        """The values [512, 1] of the next leaf."""
        return next(self.blocks)[:, None]


def _bits(masks: np.ndarray) -> np.ndarray:
    return np.unpackbits(masks, axis=-1, bitorder="little") > 0


def _unpack(stream: Stream, packed: int, size: int, codec: int) -> bytes:
    """The `size` bytes of the next grid, of which the file has so many `packed`."""
    check_size(size, stream.path, "a grid")
    if not codec:
        return stream.read(packed)
    end, data = stream.at + packed, b""
    while stream.at < end and len(data) < size:
        chunk = stream.read(*stream.unpack("<Q"))
        if CODECS.get(codec) == "zip":
            data += zlib.decompressobj().decompress(chunk, size - len(data))
        else:
            data += unpack_blosc(stream.path, chunk, size - len(data))
    return data


def _read_grids(path: Path) -> dict[str, Grid]:
    """The grids of the file at `path` by name; raises FormatError where it is of another kind."""
    check_size(path.stat().st_size, path, "the file")
    stream, grids = Stream(path, path.read_bytes()), dict[str, Grid]()
    while stream.at < len(stream.data):
        magic, version, count, codec = stream.unpack("<8sI2H")
        if magic not in MAGICS or version >> 21 != VERSION:
            raise FormatError(path, f"is no NanoVDB file of version {VERSION}")
        heads = []
        for _ in range(count):
            *head, length = stream.unpack("<2Q16x2I96xI36x")
            heads.append((*head, stream.read(length).rstrip(b"\0").decode()))
        for size, packed, kind, category, name in heads:
            grid = Stream(path, _unpack(stream, packed, size, codec), MAP_AT)
            steps = grid.array(np.dtype("<f8"), 9).reshape(3, 3).T
            grid.at = SHIFT_AT
            origin = grid.array(np.dtype("<f8"), 3)
            tree = "Tree_float_5_4_3" if kind == 1 else f"{kind} of NanoVDB (1, float, is read)"
            labels = {"class": CLASSES.get(category, b"")}
            grids[name] = NanoGrid(
                grid, VERSION, name, tree, "", 0, labels, "matrix", steps, origin, TREE_AT
            )
    return grids


def nvdb_names(path: Path) -> list[str]:
    """The names of the grids of the file at `path`; raises FormatError unless it can be read."""
    return list(_read_grids(path))


def read_nvdb(path: Path, name: str) -> Field:
    """As `read_vdb`."""
    return read_grid(_read_grids(path), name)
