"""OpenVDB files (.vdb), for Blender, Houdini and Karma, written without OpenVDB.

Each field is a fog volume of its own name, of type float, or vec3s for colors. Voxel (i, j, k) of a
file is our cell (i, j, k) along x, y, z; its center is where the grid's transform puts that index.
The background is 0, and active is what `prune` leaves. How many cells the box has, which a sparse
grid does not say, is its metadata `ddrecon_resolution`; facts about the fields are metadata as
well. Vectors of `VECTORS` are of no class, and turn with their grid.

They are of the plainest kind: not compressed, no tiles.
"""

from __future__ import annotations

import struct
import uuid
from pathlib import Path

import numpy as np

from ddrecon.io.files.arrays import as_float32
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.volumes.field import VECTORS, Facts, Fields, prune
from ddrecon.io.volumes.vdb_read import HEADER, MAGIC, POSITIONS, RESOLUTION
from ddrecon.io.volumes.vdb_tree import ACTIVE_MASK, LEAF, LOWER, SIDE, UPPER, VOXELS

FILE_VERSION, LIBRARY_VERSION = 224, (10, 0)
ONLY_ACTIVE_VALUES = b"\0"
TREES = {"Tree_float_5_4_3": 1, "Tree_vec3s_5_4_3": 3}
"""Values of a voxel, by the kind of tree."""


def write_vdb(path: Path, fields: Fields, bounds: np.ndarray, facts: Facts) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 fog volumes, pruned.

    `bounds` [2, 3], the corners (x, y, z) of the box [u], become their transform; all `facts`,
    texts and one number or three, become metadata of each.
    """
    data = HEADER.pack(MAGIC, FILE_VERSION, *LIBRARY_VERSION, 1)
    data += str(uuid.uuid4()).encode() + _metadata({}) + struct.pack("<I", len(fields))
    for name, values in fields.items():
        data += _grid(name, prune(as_float32(values)), bounds, facts, len(data))
    with replace_file(path) as temporary:
        temporary.write_bytes(data)


def _grid(name: str, values: np.ndarray, bounds: np.ndarray, facts: Facts, start: int) -> bytes:
    """The grid of `values`, and `facts`, for the place `start` in a file."""
    tree, components = list(TREES.items())[values.ndim - 3]
    descriptor = _text(name) + _text(tree) + _text("")
    cells = values.shape[2::-1]
    labels = {name: _label(fact) for name, fact in facts.items()}
    labels |= {"class": _label("fog volume"), "name": _label(name)}
    labels |= {RESOLUTION: ("vec3i", struct.pack("<3i", *cells))}
    if name in VECTORS:
        labels |= {"class": _label("unknown"), "vector_type": _label("contravariant relative")}
    places, is_active, voxels = _leaves(values)
    topology, order = _topology(places, [_bits(mask) for mask in is_active], bytes(4 * components))
    # The map from index to world: a translation, a scale, and what OpenVDB derives from it.
    size = (bounds[1] - bounds[0]) / cells
    is_uniform = np.allclose(size, size[0], rtol=1e-9, atol=0)
    numbers = [bounds[0] + size / 2, size, size, 1 / size, size**-2, 0.5 / size]
    head = struct.pack("<I", ACTIVE_MASK) + _metadata(labels)
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


def _label(fact: str | np.ndarray) -> tuple[str, bytes]:
    """The type and value of the metadata that says `fact`."""
    if isinstance(fact, str):
        return "string", fact.encode()
    return {1: "float", 3: "vec3s"}[fact.size], fact.astype("<f4").tobytes()


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
