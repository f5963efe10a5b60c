"""OpenVDB files (.vdb) of any program, read and written without OpenVDB.

Fog volumes are read: grids of half, float, double, and of vectors of three, on trees 5, 4, 3, in
files of the versions 220 to 225, compressed by zip, by Blosc or not at all. Where axes are
exchanged or mirrored, cells are put in order along x, y and z; a grid that is turned otherwise is
resampled. Grids of a file that have the same voxels share one box, around what is active in any of
them, so that a scene can have several.

A file has for each grid its metadata and its transform, which puts the center of voxel (i, j, k) in
the world; then its tree: a root, upper nodes (32³ children), lower nodes (16³), leaves (8³ voxels).
Of a tree comes the topology first: each node before its children, with the values of its tiles,
which are children that are the same all over; of leaves, which voxels are active. Then come the
voxels, leaf by leaf. Indices run with z fastest.

What is written is of the plainest kind, not compressed, without tiles: float, or vec3s for colors.
The background is 0, and active is what `prune` leaves; how many cells the box has, which a sparse
grid does not say, is its metadata.
"""

from __future__ import annotations

import itertools
import math
import re
import struct
import uuid
import warnings
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ddrecon.errors import DataWarning, FormatError
from ddrecon.extras import load_extra
from ddrecon.io.files.atomic import write_bytes
from ddrecon.io.files.reading import as_float32, check_size
from ddrecon.io.volumes.field import VECTORS, Facts, Field, Fields, check_field, prune

MAGIC, HEADER = 0x56444220, "<qIIIB"
OLDEST, NEWEST = 220, 225
"""Versions of files that are read."""
NODE_MASKS = 222
"""The version since which a node has a code: what is left out of its values."""
ALL_VALUES = 6
"""The code of a node that leaves nothing out."""
WRITTEN, LIBRARY = 224, (10, 0)
"""The versions of files and of OpenVDB that files of ours say they are of."""
RESOLUTION = "ddrecon_resolution"
"""Metadata of our own files: how many cells the box has, empty ones included."""
ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4
"""Flags of a grid: how its values are compressed."""
LEAF, LOWER, UPPER = 3, 4, 5
"""Log2 of the children along an axis, of a leaf and of the nodes above."""
SIDE, VOXELS = 2**LEAF, 2 ** (3 * LEAF)
"""Voxels of a leaf: along a side, and in all."""
NUMBERS = {"half": "<f2", "float": "<f4", "double": "<f8", "vec3s": "<f4", "vec3d": "<f8"}
"""The numbers of a value, by its type."""
LABELS = {**NUMBERS, "bool": "?", "int32": "<i4", "int64": "<i8", "vec3i": "<i4"}
"""The numbers of metadata, by its type; besides, there are texts."""
TREE = re.compile(f"Tree_({'|'.join(NUMBERS)})_5_4_3(_HalfFloat)?")
MAPS = {"TranslationMap": 3, "UniformScaleMap": 15, "ScaleMap": 15, "UnitaryMap": 16}
MAPS |= {"AffineMap": 16, "UniformScaleTranslateMap": 18, "ScaleTranslateMap": 18}
"""How many numbers a transform has, by its type."""
STEEPEST = 1e6
"""Steps whose matrix has a larger condition are no axes."""
SAME_STEPS, SAME_PLACE = 1e-6, 0.01
"""How far apart steps of the same voxels may be, of their length, and places [voxels]."""
UPRIGHT = 1e-5
"""How far a step along an axis may lead aside, of its length."""
MOTION = (*VECTORS, "vel", "v")
"""Grids that are often active in the whole box of a simulation: they widen no other grid's box."""
FAR = 2**40
NOWHERE = np.array([[FAR] * 3, [-FAR] * 3])
"""A box that holds nothing."""


class Stream:
    """The bytes `data` of the file at `path`, from the place `at` on; ValueError where they end."""

    def __init__(self, path: Path, data: bytes):
        self.path, self.data, self.at = path, data, 0

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

    def metadata(self) -> dict[str, Any]:
        """Texts, and lists of numbers, by name."""
        labels = dict[str, Any]()
        for _ in range(*self.unpack("<I")):
            name, kind, data = self.text(), self.text(), self.read(*self.unpack("<I"))
            if kind == "string":
                labels[name] = data.decode(errors="replace")
            elif kind in LABELS:
                labels[name] = np.frombuffer(data, LABELS[kind]).tolist()
        return labels

    def bits(self, count: int) -> np.ndarray:
        """Whether each of the next `count` is on, [count]."""
        return np.unpackbits(self.array(np.dtype(np.uint8), count // 8), bitorder="little") > 0


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
        ends, is_some = np.array([0, self.side - 1]), self.is_active[:, None, None]
        if self.values is None:
            # Which planes of voxels across each axis hold an active one.
            ends, blocks = np.arange(SIDE), self.is_active.reshape(-1, SIDE, SIDE, SIDE)
            is_some = np.stack([blocks.any(axes) for axes in ((2, 3), (1, 3), (1, 2))], 1)
        planes = self.corners[..., None] + ends
        low = planes.min((0, 2), initial=FAR, where=is_some)
        return np.stack([low, planes.max((0, 2), initial=-FAR - 1, where=is_some) + 1])


def join(box: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The smallest box [2, 3] around both."""
    return np.stack([np.minimum(box[0], other[0]), np.maximum(box[1], other[1])])


@dataclass(eq=False)
class Grid:
    """A grid of the file in `stream`, which is of a `version`.

    `labels` is its metadata. A step along the indices i, j, k leads along `steps` [3, 3] (x, y, z)
    [u], and voxel (0, 0, 0) has its center at `origin` [3]; both are NaN where the transform, of
    the type `map`, is not linear. The `tree`, of that type, begins at the place `begin`, or is that
    of the grid `parent`. A value has `components` numbers, compressed as `flags` say, of the type
    `stored` where there are many, and `single` where a value stands alone.
    """

    stream: Stream
    version: int
    name: str
    tree: str
    parent: str
    flags: int
    labels: Mapping[str, Any]
    map: str
    steps: np.ndarray
    origin: np.ndarray
    begin: int

    def __post_init__(self) -> None:
        match = TREE.fullmatch(self.tree)
        self.single = np.dtype(NUMBERS[match[1]] if match else "<f4")
        self.stored = np.dtype("<f2") if match and match[2] else self.single
        self.components = 3 if "vec" in self.tree else 1

    @property
    def fault(self) -> str:
        """Why it cannot be read, "" where it can."""
        if self.labels.get("class") == "level set":
            return "is a level set (distances): convert it to a fog volume first"
        if self.labels.get("class") == "staggered":
            return "is staggered (values on faces): resample it to centers of voxels first"
        if not TREE.fullmatch(self.tree):
            return f"is of type {self.tree}; Tree_..._5_4_3 of {', '.join(NUMBERS)} are read"
        if self.parent:
            return f"shares the tree of {self.parent}, which is not there"
        if not np.isfinite([*self.steps, self.origin]).all():
            return f"has a transform of type {self.map}: resample it to even voxels first"
        if not np.linalg.cond(self.steps) < STEEPEST:
            return "has a transform without three axes"
        return ""

    def legal(self, values: np.ndarray, bounds: np.ndarray) -> Field:
        """The field of its `values` in a box, and its metadata but for what tells of the file."""
        of_file = "name", RESOLUTION, "is_local_space"
        labels = {
            name: label
            for name, label in self.labels.items()
            if name not in of_file and not name.startswith("file_")
        }
        return replace(check_field(self.stream.path, self.name, values, bounds), labels=labels)

    def check_cells(self, cells: np.ndarray) -> None:
        """Raises FormatError where so many `cells` (x, y, z) take too much memory."""
        size, text = 4 * self.components * math.prod(cells.tolist()), " x ".join(map(str, cells))
        check_size(size, self.stream.path, f"{self.name}, of {text} voxels,")

    def measure(self) -> np.ndarray:
        """The box [2, 3] of the voxels that are active, or cells of ours."""
        box, cells = NOWHERE, self.labels.get(RESOLUTION, [0])
        if len(cells) == 3 and min(cells) > 0:
            box = np.array([[0, 0, 0], cells])
        return reduce(join, (nodes.measure() for nodes in self.read_topology()), box)

    def fill(self, values: np.ndarray, low: np.ndarray) -> None:
        """Writes the tree's values to `values` [x, y, z, C], the voxels from the index `low` on."""
        leaves = list[list[int]]()

        def inside(start: list[int], side: int) -> tuple[slice, ...]:
            return tuple(slice(max(at, 0), max(at + side, 0)) for at in start)

        for nodes in self.read_topology():
            starts = (nodes.corners - low).tolist()
            if nodes.values is None:
                leaves += starts
                continue
            for start, value in zip(starts, nodes.values, strict=True):
                values[inside(start, nodes.side)] = value
        for start in leaves:
            is_active, buffers = self.stream.bits(VOXELS), 1
            if self.version < NODE_MASKS:
                *_, buffers = self.stream.unpack("<3ib")
            block = self.read_masked(is_active).reshape(SIDE, SIDE, SIDE, -1)
            pairs = zip(start, values.shape, strict=False)
            within = tuple(slice(max(-at, 0), max(size - at, 0)) for at, size in pairs)
            values[inside(start, SIDE)] = block[within]
            for _ in range(buffers - 1):  # of a simulation, of which the first counts
                self.read_many(VOXELS)

    def read_topology(self) -> Iterator[Nodes]:
        """All tiles that are active or no background, and all leaves, in the order of voxels.

        The first is a tile everywhere: the background. Whoever takes them leaves the place in the
        stream alone.
        """
        stream = self.stream
        stream.at = self.begin
        if stream.unpack("<I") != (1,):
            raise ValueError("a tree has several buffers")
        self.background = self.read_singles(1)
        yield Nodes(np.full((1, 3), -FAR), 2 * FAR, np.zeros(1, bool), self.background)
        tiles, roots = stream.unpack("<II")
        layout = [("corner", "<i4", 3), ("value", self.single, (self.components,))]
        table = stream.array(np.dtype([*layout, ("is_active", "u1")]), tiles)
        values, side = table["value"].reshape(tiles, self.components), SIDE << LOWER + UPPER
        yield Nodes(table["corner"].astype(int), side, table["is_active"] > 0, values)
        for _ in range(roots):
            yield from self.read_node(np.array(stream.unpack("<3i")), UPPER, LOWER, LEAF)

    def read_node(self, corner: np.ndarray, size: int, *below: int) -> Iterator[Nodes]:
        """The next node, from `corner` on: 2^`size` children along an axis, those of 2^`below`."""
        stream, count, side = self.stream, 2 ** (3 * size), 2 ** sum(below)
        is_child, is_active = stream.bits(count), stream.bits(count)
        if self.version < NODE_MASKS:
            values = np.empty((count, self.components), self.stored)
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

    def read_masked(self, is_active: np.ndarray) -> np.ndarray:
        """The next values of a node or leaf, [n, C]; those that are not active may be left out.

        Then they are one of two values, which a mask selects.
        """
        code = ALL_VALUES if self.version < NODE_MASKS else self.stream.unpack("<B")[0]
        if code > ALL_VALUES:
            raise ValueError(f"a node has the code {code}")
        first = self.background if code == 0 else -self.background
        choices = np.concatenate([first, self.background])
        singles = {2: 1, 4: 1, 5: 2}.get(code, 0)
        choices[:singles] = self.read_singles(singles)
        selected = self.stream.bits(len(is_active)).astype(int) if code in (3, 4, 5) else 0
        if code == ALL_VALUES or not self.flags & ACTIVE_MASK:
            return self.read_many(len(is_active))
        values = np.empty((len(is_active), self.components), self.single)
        values[:] = choices[selected]
        values[is_active] = self.read_many(int(np.count_nonzero(is_active)))
        return values

    def read_singles(self, count: int) -> np.ndarray:
        """The next `count` values that stand alone, [count, C]."""
        numbers = self.stream.array(self.single, count * self.components)
        return numbers.reshape(count, self.components)

    def read_many(self, count: int) -> np.ndarray:
        """The next `count` values, [count, C]."""
        stream, size = self.stream, count * self.components * self.stored.itemsize
        if not self.flags & (ZIP | BLOSC):
            data = stream.read(size)
        elif not count and self.stored != self.single:
            data = b""  # of no halves there is not even a length
        else:
            (packed,) = stream.unpack("<q")
            data = stream.read(abs(packed))
            # No more is unpacked than there should be, of a bomb.
            if packed > 0 and self.flags & BLOSC:
                blosc = load_extra("blosc", stream.path)
                is_whole = struct.unpack_from("<I", data, 4) == (size,)
                data = blosc.decompress(data) if is_whole else b""
            elif packed > 0:
                data = zlib.decompressobj().decompress(data, size + 1)
        if len(data) != size:
            raise ValueError(f"values of {size} bytes have {len(data)}")
        return np.frombuffer(data, self.stored).reshape(count, self.components)


def _read_map(stream: Stream, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """`steps` and `origin` of the transform of a type that comes next in `stream`."""
    if kind not in MAPS:
        return np.full((3, 3), np.nan), np.full(3, np.nan)
    numbers = stream.array(np.dtype("<f8"), MAPS[kind])
    if MAPS[kind] == 16:
        rows = numbers.reshape(4, 4)
        return rows[:3, :3], rows[3, :3]
    scale = {15: numbers[:3], 18: numbers[3:6], 3: np.ones(3)}[MAPS[kind]]
    return np.diag(scale), np.zeros(3) if MAPS[kind] == 15 else numbers[:3]


def _read_grid(stream: Stream, version: int, flags: int) -> Grid:
    """The next grid of a file of a `version`, whose flags are `flags` where it has none."""
    # Grids of the same name have numbers behind a separator of records.
    name, tree, parent = (re.sub("\x1e(.*)", r"[\1]", stream.text()) for _ in range(3))
    begin, _, end = stream.unpack("<3q")
    if not stream.at <= begin <= end:
        raise ValueError(f"{name} begins at {begin} and ends at {end}")
    stream.at = begin
    if version >= NODE_MASKS:
        (flags,) = stream.unpack("<I")
    labels, kind = stream.metadata(), stream.text()
    steps, origin = _read_map(stream, kind)
    begin, stream.at = stream.at, end
    return Grid(stream, version, name, tree, parent, flags, labels, kind, steps, origin, begin)


def read_grids(path: Path) -> dict[str, Grid]:
    """The grids of the file at `path` by name, without their trees.

    Raises FormatError where it is no OpenVDB file, or of a kind that is not read.
    """
    check_size(path.stat().st_size, path, "the file")
    stream = Stream(path, path.read_bytes())
    magic, version, *_, has_places = stream.unpack(HEADER)
    if magic != MAGIC:
        raise FormatError(path, "is no OpenVDB file")
    if not OLDEST <= version <= NEWEST:
        versions = f"{OLDEST} to {NEWEST} are read"
        raise FormatError(path, f"is of the file version {version}; {versions}")
    if not has_places:
        raise FormatError(path, "was written as a stream: save it as a file, by OpenVDB's File")
    flags = ZIP if version < NODE_MASKS and stream.read(1) != b"\0" else 0
    stream.read(36)  # its UUID
    stream.metadata()
    grids = [_read_grid(stream, version, flags) for _ in range(*stream.unpack("<I"))]
    owners = {grid.name: grid for grid in grids if not grid.parent}
    for grid in grids:
        if (owner := owners.get(grid.parent)) and owner.tree == grid.tree:
            grid.begin, grid.flags, grid.parent = owner.begin, owner.flags, ""
    return {grid.name: grid for grid in grids}


def read_vdb(path: Path, name: str) -> Field:
    """The grid `name` of the file at `path`, in the box of all grids that have its voxels.

    Raises FormatError where it is no fog volume, is empty, takes too much memory, or has values
    that are not legal; what is damaged raises ValueError. Warns of a grid that is resampled.
    """
    grids = read_grids(path)
    if fault := grids[name].fault:
        raise FormatError(path, f"{name} {fault}")
    grid = grids[name]
    box, center = _place(grid, grids.values())
    sides = box[1] - box[0]
    is_along = np.abs(grid.steps) > UPRIGHT * np.abs(grid.steps).max(1, keepdims=True)
    if (is_along.sum(0) != 1).any() or (is_along.sum(1) != 1).any():
        return _read_turned(grid, sides, box[0], center)
    # Which index runs along x, y and z; it runs backward where its step does.
    order = is_along.argmax(0)
    flips = tuple(slice(None, None, int(np.sign(grid.steps[i, a]))) for a, i in enumerate(order))
    values = np.empty([*sides[order[::-1]], grid.components], np.float32)
    grid.fill(values.transpose(2, 1, 0, 3)[flips].transpose(*np.argsort(order), 3), box[0])
    corner = center - grid.steps.sum(0) / 2
    bounds = np.sort([corner, corner + sides @ grid.steps], axis=0)
    return grid.legal(values, bounds)


def _place(grid: Grid, grids: Iterable[Grid]) -> tuple[np.ndarray, np.ndarray]:
    """The box [2, 3] of the voxels of all `grids` that has those of `grid`, and its first's center.

    Raises FormatError where nothing is active, or the box takes too much memory.
    """
    box, first, is_motion = NOWHERE, None, grid.name.lower() in MOTION
    for other in grids:
        # What to add to an index of the other grid for that of the same place in this.
        shift = (other.origin - grid.origin) @ np.linalg.inv(grid.steps)
        apart = np.abs(other.steps - grid.steps).max() / np.abs(grid.steps).max()
        is_near = (np.abs(shift - np.rint(shift)) <= SAME_PLACE) & (np.abs(shift) < 2**31)
        if other.fault or not is_near.all() or not apart <= SAME_STEPS:
            continue
        shift = np.rint(shift).astype(int)
        first = first or (other, shift)
        if is_motion or other.name.lower() not in MOTION:
            box = join(box, other.measure() + shift)
    if (box[0] >= box[1]).any() or first is None:
        raise FormatError(grid.stream.path, f"{grid.name} has no active voxel")
    grid.check_cells(box[1] - box[0])
    # By the first grid's transform: rounding of their own must not tell them apart.
    return box, first[0].origin + (box[0] - first[1]) @ first[0].steps


def _read_turned(grid: Grid, sides: np.ndarray, low: np.ndarray, center: np.ndarray) -> Field:
    """A turned `grid`, of whose `sides` voxels the first, `low`, is at `center`.

    It is resampled in an upright box, in cubes of its shortest step, by trilinear interpolation.
    """
    corners = np.array([*itertools.product(*([-0.5, side - 0.5] for side in sides))]) @ grid.steps
    corners += center
    extent, side = np.ptp(corners, axis=0), np.linalg.norm(grid.steps, axis=1).min()
    cells = np.maximum(1, np.ceil(extent / side - SAME_PLACE)).astype(int)
    middle = (corners.min(0) + corners.max(0)) / 2
    bounds = middle + side * np.stack([-cells, cells]) / 2
    grid.check_cells(cells)
    size = " x ".join(map(str, cells))
    text = f"{grid.name} is turned; resampled to {size} cubes of {side:.4g} u along x, y, z"
    warnings.warn(f"{grid.stream.path}: {text}", DataWarning, 2)
    # A voxel of background around it is what lies beyond.
    source = np.empty([*(sides + 2), grid.components], np.float32)
    grid.fill(source, low - 1)
    x, y, z = (bounds[0, axis] + side * (np.arange(cells[axis]) + 0.5) for axis in range(3))
    values = np.zeros([*cells[::-1], grid.components], np.float32)
    to_index, last = np.linalg.inv(grid.steps), np.array(source.shape[:3]) - 1
    for layer, height in zip(values, z, strict=True):
        centers = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), height)], -1)
        index = np.clip((centers - center) @ to_index + 1, 0, last)
        first = np.minimum(index.astype(int), last - 1)
        for corner in itertools.product((0, 1), repeat=3):
            weight = np.abs(1 - np.array(corner) - (index - first)).prod(-1, keepdims=True)
            layer += weight * source[tuple(np.moveaxis(first + corner, -1, 0))]
    return grid.legal(values, bounds)


def write_vdb(path: Path, fields: Fields, bounds: np.ndarray, facts: Facts) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 fog volumes, pruned.

    `bounds` [2, 3], the corners (x, y, z) of the box [u], become their transform; all `facts`,
    texts and one number or three, become metadata of each. `VECTORS` turn with their grid.
    """
    data = struct.pack(HEADER, MAGIC, WRITTEN, *LIBRARY, 1) + str(uuid.uuid4()).encode()
    data += _metadata({}) + struct.pack("<I", len(fields))
    for name, values in fields.items():
        cells = np.array(values.shape[2::-1])
        labels = {**facts, "name": name, "class": "fog volume", RESOLUTION: cells}
        if name in VECTORS:
            labels |= {"class": "unknown", "vector_type": "contravariant relative"}
        # The map from index to world: a translation, a scale, and what OpenVDB derives from it.
        size = (bounds[1] - bounds[0]) / cells
        kind = "Uniform" * np.allclose(size, size[0], rtol=1e-9, atol=0) + "ScaleTranslateMap"
        numbers = np.stack([bounds[0] + size / 2, size, size, 1 / size, size**-2, 0.5 / size])
        topology, voxels = _tree(prune(as_float32(values)))
        head = struct.pack("<I", ACTIVE_MASK) + _metadata(labels) + _text(kind)
        head += numbers.astype("<f8").tobytes() + topology
        tree = f"Tree_{'vec3s' if values.ndim == 4 else 'float'}_5_4_3"
        data += _text(name) + _text(tree) + _text("")
        start = len(data) + 24
        end = start + len(head)
        data += struct.pack("<3q", start, end, end + len(voxels)) + head + voxels
    write_bytes(path, data)


def _tree(values: np.ndarray) -> tuple[bytes, bytes]:
    """The topology of the tree of `values` [z, y, x] or [z, y, x, 3], and its voxels."""
    # [x, y, z, component], padded to whole leaves; then the voxels of each, z fastest.
    colors = values.reshape(*values.shape[:3], -1).transpose(2, 1, 0, 3)
    padded = np.pad(colors, [(0, -count % SIDE) for count in colors.shape[:3]] + [(0, 0)])
    x, y, z = (count // SIDE for count in padded.shape[:3])
    blocks = padded.reshape(x, SIDE, y, SIDE, z, SIDE, -1).transpose(0, 2, 4, 1, 3, 5, 6)
    blocks = blocks.reshape(x, y, z, VOXELS, -1)
    is_active = (blocks != 0).any(-1)
    roots = _by_cube(np.argwhere(is_active.any(-1)), LOWER + UPPER)
    voxels, topology = list[bytes](), struct.pack("<i", 1) + bytes(4 * blocks.shape[-1])
    topology += struct.pack("<II", 0, len(roots))  # no tiles
    for root, inside in roots:
        nodes = _by_cube(inside, LOWER)
        corner = struct.pack("<3i", *(root << LEAF + LOWER + UPPER).tolist())
        topology += corner + _node(np.stack([node for node, _ in nodes]), UPPER)
        for _, leaves in nodes:
            topology += _node(leaves, LOWER) + _bits(is_active[tuple(leaves.T)])
            for leaf in map(tuple, leaves):
                active = blocks[leaf][is_active[leaf]].astype("<f4", copy=False)
                voxels.append(_bits(is_active[leaf]) + b"\0" + active.tobytes())
    return topology, b"".join(voxels)


def _by_cube(places: np.ndarray, size: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The cubes of side 2^`size` around `places` [n, 3], in order, each with those in it."""
    cubes, which = np.unique(places >> size, axis=0, return_inverse=True)
    return [(cube, places[which.ravel() == index]) for index, cube in enumerate(cubes)]


def _node(children: np.ndarray, size: int) -> bytes:
    """The node above `children` [n, 3], without active tiles nor, therefore, values of its own."""
    is_child = np.zeros([2**size] * 3, bool)
    is_child[tuple(children.T % 2**size)] = True
    return _bits(is_child) + bytes(is_child.size // 8) + b"\0"


def _metadata(entries: Facts) -> bytes:
    """Texts, whole numbers, or numbers, one or three."""
    data = struct.pack("<I", len(entries))
    for name, fact in entries.items():
        if isinstance(fact, str):
            kind, value = "string", fact.encode()
        elif name == RESOLUTION:
            kind, value = "vec3i", fact.astype("<i4").tobytes()
        else:
            # OpenVDB 12, as Blender 5 has it, shows Python only doubles.
            kind, value = {1: "double", 3: "vec3d"}[fact.size], fact.astype("<f8").tobytes()
        data += _text(name) + _text(kind) + struct.pack("<I", len(value)) + value
    return data


def _bits(is_on: np.ndarray) -> bytes:
    return np.packbits(is_on, bitorder="little").tobytes()


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()
