"""OpenVDB files (.vdb), for Blender, Houdini and Karma, written and read without OpenVDB.

Each field is a fog volume of its own name, of type float, or vec3s for colors. Voxel (i, j, k) of a
file is our cell (i, j, k) along x, y, z; its center is where the grid's transform puts that index.
The background is 0, and active is what `prune` leaves. How many cells the box has, which a sparse
grid does not say, is its metadata `ddrecon_resolution`.

What we write is of the plainest kind: not compressed, no tiles. No other file is read: those of
other programs are converted by OpenVDB's own Python module, which pip does not have.
"""

from __future__ import annotations

import io
import struct
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import Field, Fields, check_field, prune

RESOLUTION = "ddrecon_resolution"
MAGIC, FILE_VERSION, LIBRARY_VERSION = 0x56444220, 224, (10, 0)
ACTIVE_MASK_COMPRESSION = 2
ONLY_ACTIVE_VALUES = b"\0"
LEAF, LOWER, UPPER = 3, 4, 5
"""Log2 of the children along an axis, of a leaf and the nodes above: OpenVDB's standard tree."""
SIDE, VOXELS = 2**LEAF, 2 ** (3 * LEAF)
"""Voxels of a leaf: along a side, and in all."""
POSITIONS = struct.Struct("<3q")
"""Where a grid begins, where its voxels do, and where it ends."""
HEADER, UUID_LENGTH = struct.Struct("<qIIIB"), 36
TREES = {"Tree_float_5_4_3": 1, "Tree_vec3s_5_4_3": 3}
"""Values of a voxel, by the kind of tree."""
ADVICE = (
    "is of another program, and needs the Python module openvdb once: Blender's Python has it, and "
    "Debian's (apt-get install python3-openvdb); docs/formats.md has the lines that make it .npz"
)


def write_vdb(path: Path, fields: Fields, bounds: np.ndarray) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 fog volumes, pruned.

    `bounds` [2, 3], the corners (x, y, z) of the box [u], become their transform.
    """
    data = HEADER.pack(MAGIC, FILE_VERSION, *LIBRARY_VERSION, 1)
    data += str(uuid.uuid4()).encode() + _metadata({}) + struct.pack("<I", len(fields))
    for name, values in fields.items():
        data += _grid(name, prune(as_float32(values)), bounds, len(data))
    with replace_file(path) as temporary:
        temporary.write_bytes(data)


def _grid(name: str, values: np.ndarray, bounds: np.ndarray, start: int) -> bytes:
    """The grid of `values`, for the place `start` in a file."""
    tree, components = list(TREES.items())[values.ndim - 3]
    descriptor = _text(name) + _text(tree) + _text("")
    cells = values.shape[2::-1]
    labels = {
        "class": ("string", b"fog volume"),
        "name": ("string", name.encode()),
        RESOLUTION: ("vec3i", struct.pack("<3i", *cells)),
    }
    places, is_active, voxels = _leaves(values)
    topology, order = _topology(places, [_bits(mask) for mask in is_active], bytes(4 * components))
    # The map from index to world: a translation, a scale, and what OpenVDB derives from it.
    size = (bounds[1] - bounds[0]) / cells
    is_uniform = np.allclose(size, size[0], rtol=1e-9, atol=0)
    numbers = [bounds[0] + size / 2, size, size, 1 / size, size**-2, 0.5 / size]
    head = struct.pack("<I", ACTIVE_MASK_COMPRESSION) + _metadata(labels)
    head += _text("UniformScaleTranslateMap" if is_uniform else "ScaleTranslateMap")
    head += np.concatenate(numbers).astype("<f8").tobytes() + topology
    buffers = b"".join(
        _bits(mask) + ONLY_ACTIVE_VALUES + leaf[mask].astype("<f4", copy=False).tobytes()
        for mask, leaf in zip(is_active[order], voxels[order], strict=True)
    )
    begin = start + len(descriptor) + POSITIONS.size
    blocks = begin + len(head)
    return descriptor + POSITIONS.pack(begin, blocks, blocks + len(buffers)) + head + buffers


def _leaves(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The n leaves of `values` that hold anything but 0.

    Their places [n, 3] (x, y, z) among leaves; which of their voxels are active [n, 512]; and their
    values [n, 512, components].
    """
    # [x, y, z, component], padded to whole leaves; then the voxels of each, z fastest.
    colors = values.reshape(*values.shape[:3], -1).transpose(2, 1, 0, 3)
    padded = np.pad(colors, [(0, -count % SIDE) for count in colors.shape[:3]] + [(0, 0)])
    x, y, z = (count // SIDE for count in padded.shape[:3])
    blocks = padded.reshape(x, SIDE, y, SIDE, z, SIDE, -1).transpose(0, 2, 4, 1, 3, 5, 6)
    blocks = blocks.reshape(x, y, z, VOXELS, -1)
    is_active = (blocks != 0).any(-1)
    is_leaf = is_active.any(-1)
    return np.argwhere(is_leaf), is_active[is_leaf], blocks[is_leaf]


def _topology(places: np.ndarray, masks: list[bytes], background: bytes) -> tuple[bytes, list[int]]:
    """One buffer; the root, which has no tiles; then each node before its children.

    And the order in which leaves at `places`, with these `masks`, come.
    """
    roots, which = np.unique(places >> (LOWER + UPPER), axis=0, return_inverse=True)
    data, order = struct.pack("<i", 1) + background + struct.pack("<II", 0, len(roots)), list[int]()

    def add_node(inside: np.ndarray, size: int, *below: int) -> None:
        """Adds the node above the leaves `inside`, which has 2^`size` children along an axis."""
        nonlocal data
        child = (places[inside] >> sum(below)) % 2**size @ [2 ** (2 * size), 2**size, 1]
        is_child = np.zeros(2 ** (3 * size), bool)
        is_child[child] = True
        # No active tiles nor, therefore, values of its own.
        data += _bits(is_child) + bytes(len(is_child) // 8) + ONLY_ACTIVE_VALUES
        for index in np.unique(child) if below else ():
            add_node(inside[child == index], *below)
        if not below:
            leaves = inside[np.argsort(child)].tolist()
            data += b"".join(masks[leaf] for leaf in leaves)
            order.extend(leaves)

    for index, root in enumerate(roots.tolist()):
        data += struct.pack("<3i", *(place << (LEAF + LOWER + UPPER) for place in root))
        add_node(np.flatnonzero(which.ravel() == index), UPPER, LOWER)
    return data, order


def _metadata(entries: dict[str, tuple[str, bytes]]) -> bytes:
    records = [
        _text(name) + _text(kind) + struct.pack("<I", len(value)) + value
        for name, (kind, value) in entries.items()
    ]
    return struct.pack("<I", len(records)) + b"".join(records)


def _bits(is_on: np.ndarray) -> bytes:
    return np.packbits(is_on, bitorder="little").tobytes()


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def vdb_names(path: Path) -> list[str]:
    """The names of the grids of the file at `path`; raises FormatError unless we wrote it."""
    return list(_Stream(path).grids())


def read_vdb(path: Path, name: str) -> Field:
    """The grid `name` of the file at `path`.

    Raises FormatError where we did not write the file or its values are not legal; what is cut
    short raises ValueError.
    """
    stream = _Stream(path)
    tree, begin = stream.grids()[name]
    stream.seek(begin)
    (compression,) = stream.unpack("<I")
    labels = stream.metadata()
    is_ours = compression == ACTIVE_MASK_COMPRESSION and RESOLUTION in labels
    stream.require(tree in TREES and is_ours)
    cells, components = np.array(struct.unpack("<3i", labels[RESOLUTION])), TREES[tree]
    stream.text()
    first, size = np.frombuffer(stream.read(18 * 8), "<f8").reshape(6, 3)[:2]
    check_size(4 * components * int(cells.prod(dtype=object)), path, name)
    _, *background = stream.unpack(f"<i{components}f")
    tiles, roots = stream.unpack("<II")
    stream.require(not tiles and not any(background))
    leaves = [
        leaf
        for _ in range(roots)
        for leaf in stream.leaves(np.array(stream.unpack("<3i")), UPPER, LOWER)
    ]
    values = np.zeros([*cells[::-1], components], np.float32)  # a system makes no pages of it yet
    for place in leaves:
        block = stream.voxels(components).reshape(SIDE, SIDE, SIDE, components)
        x, y, z = np.minimum(cells - place, SIDE)
        stream.require(min(x, y, z) > 0)
        voxels = tuple(slice(at, at + SIDE) for at in place[::-1])
        values[voxels] = block[:x, :y, :z].transpose(2, 1, 0, 3)
    low = first - size / 2
    box = np.stack([low, low + size * cells])
    return check_field(path, name, values, box)


class _Stream(io.BytesIO):
    """The bytes of the file at `path`; raises FormatError unless we wrote it."""

    def __init__(self, path: Path):
        super().__init__(path.read_bytes())
        self.path = path
        magic, version, *library, has_offsets = self.unpack(HEADER.format)
        if magic != MAGIC:
            raise FormatError(path, "is no OpenVDB file")
        self.require((version, tuple(library), has_offsets) == (FILE_VERSION, LIBRARY_VERSION, 1))

    def require(self, is_ours: bool) -> None:
        """Raises FormatError unless the file is one that we have written."""
        if not is_ours:
            raise FormatError(self.path, ADVICE)

    def read(self, count: int | None = -1) -> bytes:
        data = super().read(count)
        if len(data) < (count or 0):
            raise ValueError("cut short")
        return data

    def unpack(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(layout, self.read(struct.calcsize(layout)))

    def text(self) -> str:
        return self.read(*self.unpack("<I")).decode()

    def metadata(self) -> dict[str, bytes]:
        """The value of each entry, by name."""
        entries = {}
        for _ in range(*self.unpack("<I")):
            name, _ = self.text(), self.text()
            entries[name] = self.read(*self.unpack("<I"))
        return entries

    def grids(self) -> dict[str, tuple[str, int]]:
        """The kind of tree of each grid, and where it begins, by name."""
        self.seek(HEADER.size + UUID_LENGTH)
        self.metadata()
        grids = {}
        for _ in range(*self.unpack("<I")):
            name, tree, _ = self.text(), self.text(), self.text()
            begin, _, end = self.unpack(POSITIONS.format)
            self.require(begin == self.tell() and begin < end)
            grids[name] = tree, begin
            self.seek(end)
        return grids

    def bits(self, count: int) -> np.ndarray:
        return np.unpackbits(np.frombuffer(self.read(count // 8), np.uint8), bitorder="little") > 0

    def leaves(self, corner: np.ndarray, size: int, *below: int) -> list[np.ndarray]:
        """Where each leaf under the next node begins, [3], in the order in which voxels follow.

        The node begins at `corner` and has 2^`size` children along an axis, those of 2^`below`.
        """
        is_child, is_tile = self.bits(2 ** (3 * size)), self.bits(2 ** (3 * size))
        self.require(self.read(1) == ONLY_ACTIVE_VALUES and not is_tile.any())
        places = np.stack(np.unravel_index(np.flatnonzero(is_child), [2**size] * 3), 1)
        children = corner + (places << (sum(below) + LEAF))
        if below:
            return [leaf for child in children for leaf in self.leaves(child, *below)]
        self.seek(len(children) * VOXELS // 8, io.SEEK_CUR)
        return list(children)

    def voxels(self, components: int) -> np.ndarray:
        """The next leaf's voxels [512, components]."""
        is_active = self.bits(VOXELS)
        self.require(self.read(1) == ONLY_ACTIVE_VALUES)
        voxels = np.zeros((VOXELS, components), np.float32)
        stored = self.read(4 * components * int(is_active.sum()))
        voxels[is_active] = np.frombuffer(stored, "<f4").reshape(-1, components)
        return voxels
