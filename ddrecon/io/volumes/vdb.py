"""OpenVDB files (.vdb), for Blender, Houdini and Karma, written and read without OpenVDB.

Each field is a fog volume of its own name, of type float, or vec3s for colors. Voxel (i, j, k) of a
file is our cell (i, j, k) along x, y, z; its center is where the grid's transform puts that index.
The background is 0, and active is what is not 0. How many cells the box has, which a sparse grid
does not say, is its metadata `ddrecon_resolution`.

What we write is of the plainest kind: not compressed, no tiles. No other file is read: those of
other programs are converted by OpenVDB's own Python module, which pip does not have.
"""

from __future__ import annotations

import struct
import uuid
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import as_float32, check_size
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import NO_FIELDS, Field, Fields, check_field

RESOLUTION = "ddrecon_resolution"
MAGIC, FILE_VERSION, LIBRARY_VERSION = 0x56444220, 224, (10, 0)
ACTIVE_MASK_COMPRESSION = 2
ONLY_ACTIVE_VALUES = b"\0"
LEAF, LOWER, UPPER = 3, 4, 5
"""Log2 of the children along an axis, of a leaf and the nodes above: OpenVDB's standard tree."""
SIDE, VOXELS = 2**LEAF, 2 ** (3 * LEAF)
"""Of a leaf."""
POSITIONS = struct.Struct("<3q")
HEADER, UUID_LENGTH = "<qIIIB", 36
TREES = {"Tree_float_5_4_3": 1, "Tree_vec3s_5_4_3": 3}
"""Values of a voxel, by the kind of tree."""
ADVICE = (
    "is of another program, and needs the Python module openvdb once: Blender's Python has it, and "
    "Debian's (apt-get install python3-openvdb); docs/formats.md has the line that makes it .npz"
)


def write_vdb(
    path: Path, fields: Fields, bounds: np.ndarray, constants: Fields = NO_FIELDS
) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 fog volumes.

    `bounds` [2, 3], the corners (x, y, z) of the box [u], become their transform; `constants`, each
    one number or three, metadata of the file.
    """
    data = struct.pack(HEADER, MAGIC, FILE_VERSION, *LIBRARY_VERSION, 1)
    labels = {
        name: ("float" if value.size == 1 else "vec3s", value.astype("<f4").tobytes())
        for name, value in constants.items()
    }
    data += str(uuid.uuid4()).encode() + _metadata(labels) + struct.pack("<I", len(fields))
    for name, values in fields.items():
        data += _grid(name, as_float32(values), np.asarray(bounds, np.float64), len(data))
    with replace_file(path) as temporary:
        temporary.write_bytes(data)


def _grid(name: str, values: np.ndarray, bounds: np.ndarray, start: int) -> bytes:
    """The grid of `values`, for the place `start` in a file.

    It is a descriptor that says where its parts lie, then those parts.
    """
    tree, components = list(TREES.items())[values.ndim - 3]
    descriptor = _text(name) + _text(tree) + _text("")
    cells = values.shape[2::-1]
    labels = {
        "class": ("string", b"fog volume"),
        "name": ("string", name.encode()),
        RESOLUTION: ("vec3i", struct.pack("<3i", *cells)),
    }
    keys, is_active, voxels = _leaves(values)
    head = struct.pack("<I", ACTIVE_MASK_COMPRESSION) + _metadata(labels)
    head += _transform(np.array(cells), bounds) + _topology(keys, is_active, bytes(4 * components))
    buffers = b"".join(
        _bits(mask) + ONLY_ACTIVE_VALUES + leaf[mask].astype("<f4", copy=False).tobytes()
        for mask, leaf in zip(is_active, voxels, strict=True)
    )
    begin = start + len(descriptor) + POSITIONS.size
    blocks = begin + len(head)
    return descriptor + POSITIONS.pack(begin, blocks, blocks + len(buffers)) + head + buffers


def _leaves(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The n leaves of `values` that hold anything but 0, in the order of the tree.

    Keys [n, 5]: the child (x, y, z) of the root that a leaf is under, that one's child, and its
    child; which of its voxels are active [n, 512]; and their values [n, 512, components].
    """
    # [x, y, z, component], padded to whole leaves; then the voxels of each, z fastest.
    colors = values.reshape(*values.shape[:3], -1).transpose(2, 1, 0, 3)
    padded = np.pad(colors, [(0, -count % SIDE) for count in colors.shape[:3]] + [(0, 0)])
    x, y, z = (count // SIDE for count in padded.shape[:3])
    blocks = padded.reshape(x, SIDE, y, SIDE, z, SIDE, -1).transpose(0, 2, 4, 1, 3, 5, 6)
    blocks = blocks.reshape(x, y, z, VOXELS, -1)
    is_active = (blocks != 0).any(-1)
    places = np.argwhere(is_active.any(-1))
    keys = np.column_stack(
        [places >> (LOWER + UPPER), _offset(places >> LOWER, UPPER), _offset(places, LOWER)]
    )
    order = np.lexsort(keys.T[::-1])
    at = tuple(places[order].T)
    return keys[order], is_active[at], blocks[at]


def _offset(places: np.ndarray, size: int) -> np.ndarray:
    """The number, z fastest, of a node's child at each of `places` [n, 3].

    A node has 2^size children along an axis.
    """
    return (places % 2**size) @ [2 ** (2 * size), 2**size, 1]


def _topology(keys: np.ndarray, is_active: np.ndarray, background: bytes) -> bytes:
    """One buffer; the root, which has no tiles; then each node before its children."""
    leaves = list(zip(keys.tolist(), map(_bits, is_active), strict=True))
    roots = [(root, list(below)) for root, below in groupby(leaves, lambda leaf: leaf[0][:3])]
    data = struct.pack("<i", 1) + background + struct.pack("<II", 0, len(roots))
    for root, below in roots:
        data += struct.pack("<3i", *(place << (LEAF + LOWER + UPPER) for place in root))
        data += _node([key[3] for key, _ in below], UPPER)
        for _, group in groupby(below, lambda leaf: leaf[0][3]):
            siblings = list(group)
            data += _node([key[4] for key, _ in siblings], LOWER)
            data += b"".join(mask for _, mask in siblings)
    return data


def _node(children: list[int], size: int) -> bytes:
    """A node that has these children and neither active tiles nor, therefore, values of its own."""
    is_child = np.zeros(2 ** (3 * size), bool)
    is_child[children] = True
    return _bits(is_child) + bytes(len(is_child) // 8) + ONLY_ACTIVE_VALUES


def _transform(cells: np.ndarray, bounds: np.ndarray) -> bytes:
    """The map from index to world: a translation, a scale, and what OpenVDB derives from it."""
    low, high = bounds
    size = (high - low) / cells
    is_uniform = np.allclose(size, size[0], rtol=1e-9, atol=0)
    numbers = np.concatenate([low + size / 2, size, size, 1 / size, size**-2, 0.5 / size])
    kind = "UniformScaleTranslateMap" if is_uniform else "ScaleTranslateMap"
    return _text(kind) + numbers.astype("<f8").tobytes()


def _metadata(entries: dict[str, tuple[str, bytes]]) -> bytes:
    """Each entry's name, type and value."""
    parts = [
        _text(name) + _text(kind) + struct.pack("<I", len(value)) + value
        for name, (kind, value) in entries.items()
    ]
    return struct.pack("<I", len(parts)) + b"".join(parts)


def _bits(is_on: np.ndarray) -> bytes:
    return np.packbits(is_on, bitorder="little").tobytes()


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def vdb_names(path: Path) -> list[str]:
    """The names of the grids of the file at `path`; raises FormatError unless we wrote it."""
    return list(_read(path))


def read_vdb(path: Path, name: str) -> Field:
    """The grid `name` of the file at `path`.

    Raises FormatError where we did not write the file, where it is damaged or has no such grid.
    """
    fields = _read(path)
    if name not in fields:
        known = ", ".join(map(repr, fields)) or "none"
        raise FormatError(path, f"has no grid {name!r}; it has {known}")
    return fields[name]


def _read(path: Path) -> dict[str, Field]:
    """The fields by name; what is cut short raises struct.error, ValueError or IndexError."""
    stream = _Stream(path)
    magic, version, *library, has_offsets = stream.unpack(HEADER)
    if magic != MAGIC:
        raise FormatError(path, "is no OpenVDB file")
    stream.require((version, tuple(library), has_offsets) == (FILE_VERSION, LIBRARY_VERSION, 1))
    stream.take(UUID_LENGTH)
    stream.metadata()
    return dict(_read_grid(path, stream) for _ in range(*stream.unpack("<I")))


def _read_grid(path: Path, stream: _Stream) -> tuple[str, Field]:
    """The next grid of `stream`: its name and field."""
    name, tree, _ = stream.text(), stream.text(), stream.text()
    stream.unpack(POSITIONS.format)
    (compression,) = stream.unpack("<I")
    labels = stream.metadata()
    is_ours = compression == ACTIVE_MASK_COMPRESSION and RESOLUTION in labels
    stream.require(tree in TREES and is_ours)
    cells, components = np.array(struct.unpack("<3i", labels[RESOLUTION])), TREES[tree]
    stream.text()
    first, size = np.frombuffer(stream.take(18 * 8), "<f8").reshape(6, 3)[:2]
    check_size(4 * components * int(cells.prod(dtype=object)), path, name)
    # [x, y, z, component], in whole leaves until they are all there.
    values = np.zeros([*(-(-cells // SIDE) * SIDE), components], np.float32)
    for x, y, z in _read_places(stream, components):
        block = _read_voxels(stream, components).reshape(SIDE, SIDE, SIDE, components)
        values[x : x + SIDE, y : y + SIDE, z : z + SIDE] = block
    x, y, z = cells
    inside = values[:x, :y, :z].transpose(2, 1, 0, 3)
    low = first - size / 2
    box = np.stack([low, low + size * cells])
    return name, check_field(path, name, inside[..., 0] if components == 1 else inside, box)


def _read_places(stream: _Stream, components: int) -> list[tuple[int, int, int]]:
    """Where each leaf begins, in the order in which their voxels follow."""
    _, *background = stream.unpack(f"<i{components}f")
    tiles, roots = stream.unpack("<II")
    stream.require(not tiles and not any(background))
    leaves = []
    for _ in range(roots):
        root = np.array(stream.unpack("<3i"))
        for upper in [root + place for place in stream.children(UPPER, LOWER + LEAF)]:
            places = [upper + place for place in stream.children(LOWER, LEAF)]
            stream.take(len(places) * VOXELS // 8)
            leaves += [(int(x), int(y), int(z)) for x, y, z in places]
    return leaves


def _read_voxels(stream: _Stream, components: int) -> np.ndarray:
    """The next leaf's voxels [512, components]."""
    is_active = stream.bits(VOXELS)
    stream.require(stream.take(1) == ONLY_ACTIVE_VALUES)
    voxels = np.zeros((VOXELS, components), np.float32)
    count = 4 * components * int(is_active.sum())
    voxels[is_active] = np.frombuffer(stream.take(count), "<f4").reshape(-1, components)
    return voxels


class _Stream:
    """The bytes of the file at `path`, from their beginning."""

    def __init__(self, path: Path):
        self.path, self.data, self.place = path, path.read_bytes(), 0

    def require(self, is_ours: bool) -> None:
        """Raises FormatError unless the file is one that we have written."""
        if not is_ours:
            raise FormatError(self.path, ADVICE)

    def take(self, count: int) -> bytes:
        taken = self.data[self.place : self.place + count]
        if len(taken) < count:
            raise ValueError("cut short")
        self.place += count
        return taken

    def unpack(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(layout, self.take(struct.calcsize(layout)))

    def text(self) -> str:
        return self.take(*self.unpack("<I")).decode()

    def metadata(self) -> dict[str, bytes]:
        """The value of each entry, by name."""
        entries = {}
        for _ in range(*self.unpack("<I")):
            name, _ = self.text(), self.text()
            entries[name] = self.take(*self.unpack("<I"))
        return entries

    def bits(self, count: int) -> np.ndarray:
        return np.unpackbits(np.frombuffer(self.take(count // 8), np.uint8), bitorder="little") > 0

    def children(self, size: int, below: int) -> np.ndarray:
        """Where the children of the next node begin, [n, 3], from where it does.

        It has 2^`size` children along an axis, each of 2^`below` voxels.
        """
        is_child, is_tile = self.bits(2 ** (3 * size)), self.bits(2 ** (3 * size))
        self.require(self.take(1) == ONLY_ACTIVE_VALUES and not is_tile.any())
        places = np.unravel_index(np.flatnonzero(is_child), [2**size] * 3)
        return np.stack(places, 1) << below
