"""OpenVDB files (.vdb), for Blender, Houdini and Karma, written without OpenVDB.

Each field is a fog volume of its own name, of type float, or vec3s for colors. Voxel (i, j, k) of a
file is our cell (i, j, k) along x, y, z; its center is where the grid's transform puts that index.
The background is 0, and active is what is not 0. How many cells the box has, which a sparse grid
does not say, is its metadata `ddrecon_resolution`.
"""

from __future__ import annotations

import struct
import uuid
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np

from ddrecon.io.files.arrays import as_float32
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import NO_FIELDS, Fields

RESOLUTION = "ddrecon_resolution"
MAGIC, FILE_VERSION, LIBRARY_VERSION = 0x56444220, 224, (10, 0)
ACTIVE_MASK_COMPRESSION = 2
ONLY_ACTIVE_VALUES = b"\0"
LEAF, LOWER, UPPER = 3, 4, 5
"""Log2 of the children along an axis, of a leaf and the nodes above: OpenVDB's standard tree."""
POSITIONS = struct.Struct("<3q")
HEADER, UUID_LENGTH = "<qIIIB", 36
TREE = "Tree_{}_5_4_3"


def write_vdb(
    path: Path, fields: Fields, bounds: np.ndarray, constants: Fields = NO_FIELDS
) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 fog volumes.

    `bounds` [2, 3], the corners (x, y, z) of the box [u], become their transform; `constants`, each
    one number or three, metadata of the file.
    """
    header = (
        struct.pack(HEADER, MAGIC, FILE_VERSION, *LIBRARY_VERSION, 1) + str(uuid.uuid4()).encode()
    )
    labels = {name: _label(value) for name, value in constants.items()}
    data = header + _metadata(labels) + struct.pack("<I", len(fields))
    for name, values in fields.items():
        data += _grid(name, as_float32(values), np.asarray(bounds, np.float64), len(data))
    with replace_file(path) as temporary:
        temporary.write_bytes(data)


def _grid(name: str, values: np.ndarray, bounds: np.ndarray, start: int) -> bytes:
    """The grid of `values`, for the place `start` in a file.

    It is a descriptor that says where its parts lie, then those parts.
    """
    kind = "float" if values.ndim == 3 else "vec3s"
    descriptor = _text(name) + _text(TREE.format(kind)) + _text("")
    cells = values.shape[2::-1]
    labels = {
        "class": ("string", b"fog volume"),
        "name": ("string", name.encode()),
        RESOLUTION: ("vec3i", struct.pack("<3i", *cells)),
    }
    leaves = _leaves(values)
    head = (
        struct.pack("<I", ACTIVE_MASK_COMPRESSION)
        + _metadata(labels)
        + _transform(np.array(cells), bounds)
    )
    topology, buffers = (
        _topology(leaves, bytes(4 * (1 if values.ndim == 3 else 3))),
        _buffers(leaves),
    )
    begin = start + len(descriptor) + POSITIONS.size
    blocks = begin + len(head) + len(topology)
    return (
        descriptor
        + POSITIONS.pack(begin, blocks, blocks + len(buffers))
        + head
        + topology
        + buffers
    )


@dataclass(frozen=True)
class _Leaf:
    """8^3 voxels: which are active, and their values.

    It is under the child `root` (x, y, z) of the root, that one's child number `upper`, and its
    child number `lower`.
    """

    root: tuple[int, int, int]
    upper: int
    lower: int
    mask: bytes
    values: bytes


def _leaves(values: np.ndarray) -> list[_Leaf]:
    """The leaves of `values` that hold anything but 0, in the order of the tree."""
    # [x, y, z, color], padded to whole leaves.
    colors = values.reshape(*values.shape[:3], -1).transpose(2, 1, 0, 3)
    padded = np.pad(colors, [(0, -count % 8) for count in colors.shape[:3]] + [(0, 0)])
    x, y, z = (count // 8 for count in padded.shape[:3])
    # The 512 voxels of each leaf, z fastest.
    blocks = (
        padded.reshape(x, 8, y, 8, z, 8, -1)
        .transpose(0, 2, 4, 1, 3, 5, 6)
        .reshape(x, y, z, 512, -1)
    )
    is_active = (blocks != 0).any(-1)
    # Leaves that hold something, in order of the nodes they are under, from the top.
    places = np.argwhere(is_active.any(-1))
    keys = np.column_stack(
        [places >> (LOWER + UPPER), _offset(places >> LOWER, UPPER), _offset(places, LOWER)]
    )
    return [
        _leaf(keys[i].tolist(), blocks[tuple(places[i])], is_active[tuple(places[i])])
        for i in np.lexsort(keys.T[::-1])
    ]


def _leaf(key: list[int], voxels: np.ndarray, is_active: np.ndarray) -> _Leaf:
    x, y, z, upper, lower = key
    return _Leaf(
        (x, y, z),
        upper,
        lower,
        _bits(is_active),
        voxels[is_active].astype("<f4", copy=False).tobytes(),
    )


def _offset(places: np.ndarray, size: int) -> np.ndarray:
    """The number, z fastest, of a node's child at each of `places` [n, 3].

    A node has 2^size children along an axis.
    """
    return (places % 2**size) @ [2 ** (2 * size), 2**size, 1]


def _bits(is_on: np.ndarray) -> bytes:
    return np.packbits(is_on, bitorder="little").tobytes()


def _topology(leaves: list[_Leaf], background: bytes) -> bytes:
    """One buffer; the root, which has no tiles; then each node before its children."""
    roots = [(root, list(members)) for root, members in groupby(leaves, lambda leaf: leaf.root)]
    data = struct.pack("<i", 1) + background + struct.pack("<II", 0, len(roots))
    side = 2 ** (LEAF + LOWER + UPPER)
    for root, members in roots:
        data += struct.pack("<3i", *(side * place for place in root))
        data += _node([leaf.upper for leaf in members], UPPER)
        for _, siblings in groupby(members, lambda leaf: leaf.upper):
            below = list(siblings)
            data += _node([leaf.lower for leaf in below], LOWER)
            data += b"".join(leaf.mask for leaf in below)
    return data


def _buffers(leaves: list[_Leaf]) -> bytes:
    return b"".join(leaf.mask + ONLY_ACTIVE_VALUES + leaf.values for leaf in leaves)


def _node(children: list[int], size: int) -> bytes:
    """A node that has these children and neither active tiles nor, therefore, values of its own."""
    is_child = np.zeros(2 ** (3 * size), bool)
    is_child[children] = True
    return _bits(is_child) + bytes(len(is_child) // 8) + ONLY_ACTIVE_VALUES


def _transform(cells: np.ndarray, bounds: np.ndarray) -> bytes:
    """The map from index to world: a translation, a scale, and what OpenVDB derives from it."""
    low, high = bounds
    size = (high - low) / cells
    kind = (
        "UniformScaleTranslateMap"
        if np.allclose(size, size[0], rtol=1e-9, atol=0)
        else "ScaleTranslateMap"
    )
    numbers = np.concatenate([low + size / 2, size, size, 1 / size, size**-2, 0.5 / size])
    return _text(kind) + numbers.astype("<f8").tobytes()


def _metadata(entries: dict[str, tuple[str, bytes]]) -> bytes:
    """Each entry's name, type and value."""
    parts = [
        _text(name) + _text(kind) + struct.pack("<I", len(value)) + value
        for name, (kind, value) in entries.items()
    ]
    return struct.pack("<I", len(parts)) + b"".join(parts)


def _label(value: np.ndarray) -> tuple[str, bytes]:
    """One number or three, as the type and the value of an entry."""
    return "float" if value.size == 1 else "vec3s", value.astype("<f4").tobytes()


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()
