"""Reading those OpenVDB files that `ddrecon.io.volumes.vdb` has written, without OpenVDB.

They are of the plainest kind: not compressed, no tiles, a background of 0. Files of other programs
are converted by OpenVDB's own Python module, which pip does not have.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.errors import FormatError
from ddrecon.io.files.arrays import check_size
from ddrecon.io.volumes.field import Field, check_field
from ddrecon.io.volumes.vdb import (
    ACTIVE_MASK_COMPRESSION,
    FILE_VERSION,
    HEADER,
    LEAF,
    LIBRARY_VERSION,
    LOWER,
    MAGIC,
    ONLY_ACTIVE_VALUES,
    POSITIONS,
    RESOLUTION,
    TREE,
    UPPER,
    UUID_LENGTH,
)

COMPONENTS = {TREE.format("float"): 1, TREE.format("vec3s"): 3}
"""Values of a voxel, by the kind of tree."""
ADVICE = (
    "is of another program, and needs the Python module openvdb once: Blender's Python has it, and "
    "Debian's (apt-get install python3-openvdb); docs/formats.md has the line that makes it .npz"
)


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
    (count,) = stream.unpack("<I")
    return dict(_grid(path, stream) for _ in range(count))


def _grid(path: Path, stream: _Stream) -> tuple[str, Field]:
    """The next grid of `stream`: its name and field."""
    name, tree, _ = stream.text(), stream.text(), stream.text()
    stream.unpack(POSITIONS.format)
    (compression,) = stream.unpack("<I")
    labels = stream.metadata()
    is_ours = compression == ACTIVE_MASK_COMPRESSION and RESOLUTION in labels
    stream.require(tree in COMPONENTS and is_ours)
    cells = np.array(struct.unpack("<3i", labels[RESOLUTION]))
    stream.text()
    first, size = np.frombuffer(stream.take(18 * 8), "<f8").reshape(6, 3)[:2]
    components = COMPONENTS[tree]
    check_size(4 * components * int(cells.prod(dtype=object)), path, name)
    # [x, y, z, component], in whole leaves until they are all there.
    side = 2**LEAF
    values = np.zeros([*(-(-cells // side) * side), components], np.float32)
    for x, y, z in _leaves(stream, components):
        block = _voxels(stream, components).reshape(side, side, side, components)
        values[x : x + side, y : y + side, z : z + side] = block
    x, y, z = cells
    inside = values[:x, :y, :z].transpose(2, 1, 0, 3)
    low = first - size / 2
    box = np.stack([low, low + size * cells])
    return name, check_field(path, name, inside[..., 0] if components == 1 else inside, box)


def _leaves(stream: _Stream, components: int) -> list[tuple[int, int, int]]:
    """Where each leaf begins, in the order in which their voxels follow."""
    _, *background = stream.unpack(f"<i{components}f")
    tiles, roots = stream.unpack("<II")
    stream.require(not tiles and not any(background))
    leaves = []
    for _ in range(roots):
        root = np.array(stream.unpack("<3i"))
        uppers = [root + place for place in stream.node(UPPER, LOWER + LEAF)]
        for upper in uppers:
            places = [upper + place for place in stream.node(LOWER, LEAF)]
            stream.take(len(places) * 2 ** (3 * LEAF) // 8)
            leaves += [(int(x), int(y), int(z)) for x, y, z in places]
    return leaves


def _voxels(stream: _Stream, components: int) -> np.ndarray:
    """The next leaf's 512 voxels [512, components]."""
    is_active = stream.bits(2 ** (3 * LEAF))
    stream.require(stream.take(1) == ONLY_ACTIVE_VALUES)
    voxels = np.zeros((len(is_active), components), np.float32)
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
        return self.take(self.unpack("<I")[0]).decode()

    def metadata(self) -> dict[str, bytes]:
        """The value of each entry, by name."""
        entries = {}
        for _ in range(self.unpack("<I")[0]):
            name, _ = self.text(), self.text()
            entries[name] = self.take(self.unpack("<I")[0])
        return entries

    def bits(self, count: int) -> np.ndarray:
        return np.unpackbits(np.frombuffer(self.take(count // 8), np.uint8), bitorder="little") > 0

    def node(self, size: int, below: int) -> np.ndarray:
        """Where the children of the next node begin, [n, 3], from where it does.

        It has 2^`size` children along an axis, each of 2^`below` voxels.
        """
        is_child, is_tile = self.bits(2 ** (3 * size)), self.bits(2 ** (3 * size))
        self.require(self.take(1) == ONLY_ACTIVE_VALUES and not is_tile.any())
        places = np.unravel_index(np.flatnonzero(is_child), [2**size] * 3)
        return np.stack(places, 1) << below
