"""OpenVDB files (.vdb) of any program, read and written without OpenVDB.

Fog volumes are read: grids of half, float, double, and of vectors of three, on trees 5, 4, 3, in
files of the versions 220 to 225, compressed by zip, by Blosc or not at all. Level sets, points and
other trees are refused. Where axes are exchanged or mirrored, cells are put in order along x, y and
z; a grid that is turned otherwise is resampled. Grids of a file that have the same voxels share one
box, around what is active in any of them, so that a scene can have several.

What is written is of the plainest kind, not compressed, without tiles: float, or vec3s for colors.
The background is 0, and active is what `prune` leaves; how many cells the box has, which a sparse
grid does not say, is its metadata.

A grid's transform puts the center of voxel (i, j, k) in the world. What is written has our cell
(i, j, k) along x, y, z there.
"""

from __future__ import annotations

import itertools
import re
import struct
import uuid
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np

from ddrecon.errors import DataWarning, FormatError
from ddrecon.io.files.atomic import write_bytes
from ddrecon.io.files.reading import as_float32, check_size
from ddrecon.io.volumes.field import VECTORS, Facts, Field, Fields, check_field, prune
from ddrecon.io.volumes.vdb_tree import (
    ACTIVE_MASK,
    LEAF,
    LOWER,
    NODE_MASKS,
    NOWHERE,
    SIDE,
    UPPER,
    VOXELS,
    ZIP,
    Coding,
    Stream,
    Tree,
    join,
)

MAGIC, HEADER = 0x56444220, "<qIIIB"
OLDEST, NEWEST = 220, 225
"""Versions of files that are read."""
WRITTEN, LIBRARY = 224, (10, 0)
"""The versions of files and of OpenVDB that files of ours say they are of."""
RESOLUTION = "ddrecon_resolution"
"""Metadata of our own files: how many cells the box has, empty ones included."""
NUMBERS = {"half": "<f2", "float": "<f4", "double": "<f8", "vec3s": "<f4", "vec3d": "<f8"}
"""The numbers of a value, by its type."""
TREE = re.compile(f"Tree_({'|'.join(NUMBERS)})_5_4_3(_HalfFloat)?")
MAPS = {
    "TranslationMap": 3,
    **dict.fromkeys(("UniformScaleMap", "ScaleMap"), 15),
    **dict.fromkeys(("UnitaryMap", "AffineMap"), 16),
    **dict.fromkeys(("UniformScaleTranslateMap", "ScaleTranslateMap"), 18),
}
"""How many numbers a transform has, by its type."""
STEEPEST = 1e6
"""Steps whose matrix has a larger condition are no axes."""
SAME_STEPS, SAME_PLACE = 1e-6, 0.01
"""How far apart steps of the same voxels may be, of their length, and places [voxels]."""
UPRIGHT = 1e-5
"""How far a step along an axis may lead aside, of its length."""
MOTION = (*VECTORS, "vel", "v")
"""Grids that are often active in the whole box of a simulation: they widen no other grid's box."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A grid as its file has it.

    `labels` is its metadata. A step along the indices i, j, k leads along `steps` [3, 3] (x, y, z)
    [u], and voxel (0, 0, 0) has its center at `origin` [3]; both are NaN where the transform, of
    the type `map`, is not linear. `parent` is the name of the grid whose tree is this one's, too;
    else the grid's own begins at the place `begin`. `coding` is None for trees that are not read.
    """

    name: str
    tree: str
    parent: str
    labels: Mapping[str, bytes]
    map: str
    steps: np.ndarray
    origin: np.ndarray
    coding: Coding | None
    begin: int

    @property
    def fault(self) -> str:
        """Why it cannot be read, "" where it can."""
        if self.labels.get("class") == b"level set":
            return "is a level set (distances): convert it to a fog volume first"
        if self.labels.get("class") == b"staggered":
            return "is staggered (values on faces): resample it to centers of voxels first"
        if self.coding is None:
            return f"is of type {self.tree}; Tree_..._5_4_3 of {', '.join(NUMBERS)} are read"
        if not np.isfinite([*self.steps, self.origin]).all():
            return f"has a transform of type {self.map}: resample it to even voxels first"
        if not np.linalg.cond(self.steps) < STEEPEST:
            return "has a transform without three axes"
        return ""

    def shift(self, other: Grid) -> np.ndarray | None:
        """What to add to an index [3] of `other` for that of the same place here.

        None where the voxels are not the same.
        """
        if self.fault or other.fault:
            return None
        if np.abs(self.steps - other.steps).max() > SAME_STEPS * np.abs(self.steps).max():
            return None
        shift = (other.origin - self.origin) @ np.linalg.inv(self.steps)
        if not (np.abs(shift) < 2**31).all() or np.abs(shift - np.rint(shift)).max() > SAME_PLACE:
            return None
        return np.rint(shift).astype(int)


class _File:
    """The file at `path`, of a `version`, and its `grids` by name.

    Raises FormatError where it is no OpenVDB file, or of a kind that is not read.
    """

    def __init__(self, path: Path):
        check_size(path.stat().st_size, path, "the file")
        self.path, self.stream = path, (stream := Stream(path, path.read_bytes()))
        magic, self.version, *_, has_places = stream.unpack(HEADER)
        if magic != MAGIC:
            raise FormatError(path, "is no OpenVDB file")
        if not OLDEST <= self.version <= NEWEST:
            versions = f"{OLDEST} to {NEWEST} are read"
            raise FormatError(path, f"is of the file version {self.version}; {versions}")
        if not has_places:
            raise FormatError(path, "was written as a stream: save it as a file, by OpenVDB's File")
        self.flags = ZIP if self.version < NODE_MASKS and stream.read(1) != b"\0" else 0
        stream.read(36)  # its UUID
        stream.metadata()
        grids = (self._read_grid() for _ in range(*stream.unpack("<I")))
        self.grids = {grid.name: grid for grid in grids}

    def _read_grid(self) -> Grid:
        """The next grid, all but its tree."""
        stream, coding = self.stream, None
        # Grids of the same name have numbers behind a separator of records.
        name, tree, parent = (re.sub("\x1e(.*)", r"[\1]", stream.text()) for _ in range(3))
        begin, _, end = stream.unpack("<3q")
        if not stream.at <= begin <= end:
            raise ValueError(f"{name} begins at {begin} and ends at {end}")
        stream.at = begin
        (flags,) = stream.unpack("<I") if self.version >= NODE_MASKS else (self.flags,)
        labels, kind = stream.metadata(), stream.text()
        steps, origin = _read_map(stream, kind)
        begin, stream.at = stream.at, end
        if match := TREE.fullmatch(tree):
            number = np.dtype(NUMBERS[match[1]])
            stored = np.dtype("<f2") if match[2] else number
            coding = Coding(self.version, flags, stored, number, 3 if "vec" in tree else 1)
        return Grid(name, tree, parent, labels, kind, steps, origin, coding, begin)

    def require(self, name: str) -> Grid:
        """The grid `name`; raises FormatError where it cannot be read."""
        if fault := self.grids[name].fault:
            raise FormatError(self.path, f"{name} {fault}")
        return self.grids[name]

    def tree_of(self, grid: Grid) -> Tree:
        if grid.parent:
            owner = self.grids.get(grid.parent)
            if owner is None or owner.parent:
                fault = f"shares the tree of {grid.parent}, which is not there"
                raise FormatError(self.path, f"{grid.name} {fault}")
            grid = self.require(owner.name)
        assert grid.coding is not None
        return Tree(self.stream, grid.coding, grid.begin)

    def measure(self, grid: Grid) -> np.ndarray:
        """The box [2, 3] of the voxels of `grid` that are active, or cells of ours."""
        box, cells = self.tree_of(grid).measure(), grid.labels.get(RESOLUTION, b"")
        if len(cells) == 12 and min(sides := struct.unpack("<3i", cells)) > 0:
            box = join(box, np.array([[0, 0, 0], sides]))
        return box

    def place(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """The box [2, 3] of voxels of all grids like `grid`, and the center [3] of its first.

        Raises FormatError where nothing is active, or the box takes too much memory.
        """
        shifts = {other.name: grid.shift(other) for other in self.grids.values()}
        same = {name: shift for name, shift in shifts.items() if shift is not None}
        is_motion = grid.name.lower() in MOTION
        counted = [name for name in same if is_motion or name.lower() not in MOTION]
        boxes = (self.measure(self.grids[name]) + same[name] for name in counted)
        box = reduce(join, boxes, NOWHERE)
        if (box[0] >= box[1]).any():
            raise FormatError(self.path, f"{grid.name} has no active voxel")
        self.check_cells(grid, box[1] - box[0])
        # By the first grid's transform: rounding of their own must not tell them apart.
        first = self.grids[next(iter(same))]
        return box, first.origin + (box[0] - same[first.name]) @ first.steps

    def check_cells(self, grid: Grid, cells: np.ndarray) -> None:
        """Raises FormatError where `grid` in so many `cells` (x, y, z) takes too much memory."""
        assert grid.coding is not None
        x, y, z = (int(side) for side in cells)
        size = 4 * grid.coding.components * x * y * z
        check_size(size, self.path, f"{grid.name}, of {x} x {y} x {z} voxels,")


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


def vdb_names(path: Path) -> list[str]:
    """The names of the grids of the file at `path`; raises FormatError unless it can be read."""
    return list(_File(path).grids)


def read_vdb(path: Path, name: str) -> Field:
    """The grid `name` of the file at `path`, in the box of all grids that have its voxels.

    Raises FormatError where it is no fog volume, is empty, takes too much memory, or has values
    that are not legal; what is damaged raises ValueError. Warns of a grid that is resampled.
    """
    file = _File(path)
    grid = file.require(name)
    box, center = file.place(grid)
    tree, sides = file.tree_of(grid), box[1] - box[0]
    is_along = np.abs(grid.steps) > UPRIGHT * np.abs(grid.steps).max(1, keepdims=True)
    if (is_along.sum(0) != 1).any() or (is_along.sum(1) != 1).any():
        return _read_turned(file, grid, tree, sides, box[0], center)
    # Which index runs along x, y and z; it runs backward where its step does.
    order = is_along.argmax(0)
    flips = tuple(slice(None, None, int(np.sign(grid.steps[i, a]))) for a, i in enumerate(order))
    values = np.empty([*sides[order[::-1]], tree.coding.components], np.float32)
    by_index = values.transpose(2, 1, 0, 3)[flips].transpose(*np.argsort(order), 3)
    tree.fill(by_index, box[0])
    corner = center - grid.steps.sum(0) / 2
    bounds = np.sort([corner, corner + sides @ grid.steps], axis=0)
    return check_field(path, name, values, bounds)


def _read_turned(
    file: _File, grid: Grid, tree: Tree, sides: np.ndarray, low: np.ndarray, center: np.ndarray
) -> Field:
    """The `tree` of a turned `grid`, of whose `sides` voxels the first, `low`, is at `center`.

    It is resampled in an upright box, in cubes of its shortest step, by trilinear interpolation.
    """
    corners = np.array([*itertools.product(*([-0.5, side - 0.5] for side in sides))]) @ grid.steps
    corners += center
    extent, side = np.ptp(corners, axis=0), np.linalg.norm(grid.steps, axis=1).min()
    cells = np.maximum(1, np.ceil(extent / side - SAME_PLACE)).astype(int)
    middle = (corners.min(0) + corners.max(0)) / 2
    bounds = middle + side * np.stack([-cells, cells]) / 2
    file.check_cells(grid, cells)
    size = " x ".join(map(str, cells))
    text = f"{grid.name} is turned; resampled to {size} cubes of {side:.4g} u along x, y, z"
    warnings.warn(f"{file.path}: {text}", DataWarning, 2)
    # A voxel of background around it is what lies beyond.
    source = np.empty([*(sides + 2), tree.coding.components], np.float32)
    tree.fill(source, low - 1)
    x, y, z = (bounds[0, axis] + side * (np.arange(cells[axis]) + 0.5) for axis in range(3))
    values = np.zeros([*cells[::-1], source.shape[3]], np.float32)
    to_index, last = np.linalg.inv(grid.steps), np.array(source.shape[:3]) - 1
    for layer, height in zip(values, z, strict=True):
        centers = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), height)], -1)
        index = np.clip((centers - center) @ to_index + 1, 0, last)
        first = np.minimum(index.astype(int), last - 1)
        for corner in itertools.product((0, 1), repeat=3):
            weight = np.abs(1 - np.array(corner) - (index - first)).prod(-1, keepdims=True)
            layer += weight * source[tuple(np.moveaxis(first + corner, -1, 0))]
    return check_field(file.path, grid.name, values, bounds)


def write_vdb(path: Path, fields: Fields, bounds: np.ndarray, facts: Facts) -> None:
    """Writes `fields`, each [z, y, x] or [z, y, x, 3], as float32 fog volumes, pruned.

    `bounds` [2, 3], the corners (x, y, z) of the box [u], become their transform; all `facts`,
    texts and one number or three, become metadata of each. `VECTORS` turn with their grid.
    """
    data = struct.pack(HEADER, MAGIC, WRITTEN, *LIBRARY, 1) + str(uuid.uuid4()).encode()
    data += _metadata({}) + struct.pack("<I", len(fields))
    for name, values in fields.items():
        data += _text(name) + _text(f"Tree_{'vec3s' if values.ndim == 4 else 'float'}_5_4_3")
        data += _text("")
        head, buffers = _grid(name, prune(as_float32(values)), bounds, facts)
        blocks = len(data) + 24 + len(head)
        data += struct.pack("<3q", blocks - len(head), blocks, blocks + len(buffers))
        data += head + buffers
    write_bytes(path, data)


def _grid(name: str, values: np.ndarray, bounds: np.ndarray, facts: Facts) -> tuple[bytes, bytes]:
    """The grid of `values` with `facts`: all but its voxels, and these."""
    cells, is_vector = values.shape[2::-1], name in VECTORS
    labels: dict[str, str | np.ndarray] = {**facts, "name": name}
    labels |= {"class": "unknown" if is_vector else "fog volume", RESOLUTION: np.array(cells)}
    labels |= {"vector_type": "contravariant relative"} if is_vector else {}
    # The map from index to world: a translation, a scale, and what OpenVDB derives from it.
    size = (bounds[1] - bounds[0]) / cells
    is_uniform = np.allclose(size, size[0], rtol=1e-9, atol=0)
    numbers = np.concatenate([bounds[0] + size / 2, size, size, 1 / size, size**-2, 0.5 / size])
    head = struct.pack("<I", ACTIVE_MASK) + _metadata(labels)
    head += _text("UniformScaleTranslateMap" if is_uniform else "ScaleTranslateMap")
    places, is_active, voxels = _leaves(values)
    topology, order = _topology(places, is_active, bytes(4 * voxels.shape[2]))
    buffers = b"".join(
        _bits(mask) + b"\0" + leaf[mask].astype("<f4", copy=False).tobytes()
        for mask, leaf in zip(is_active[order], voxels[order], strict=True)
    )
    return head + numbers.astype("<f8").tobytes() + topology, buffers


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


def _topology(
    places: np.ndarray, is_active: np.ndarray, background: bytes
) -> tuple[bytes, list[int]]:
    """One buffer; the root, which has no tiles; then each node before its children.

    And the order in which leaves at `places`, with voxels that are active, come.
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
        data += _bits(is_child) + bytes(len(is_child) // 8) + b"\0"
        for index in np.unique(child) if below else ():
            add_node(inside[child == index], *below)
        if not below:
            leaves = inside[np.argsort(child)]
            data += _bits(is_active[leaves])
            order.extend(leaves.tolist())

    for index, root in enumerate(roots.tolist()):
        data += struct.pack("<3i", *(place << (LEAF + LOWER + UPPER) for place in root))
        add_node(np.flatnonzero(which.ravel() == index), UPPER, LOWER)
    return data, order


def _metadata(entries: Mapping[str, str | np.ndarray]) -> bytes:
    """Texts, whole numbers, or numbers, one or three."""
    data = struct.pack("<I", len(entries))
    for name, fact in entries.items():
        if isinstance(fact, str):
            kind, value = "string", fact.encode()
        else:
            is_whole = name == RESOLUTION
            kind = "vec3i" if is_whole else {1: "float", 3: "vec3s"}[fact.size]
            value = fact.astype("<i4" if is_whole else "<f4").tobytes()
        data += _text(name) + _text(kind) + struct.pack("<I", len(value)) + value
    return data


def _bits(is_on: np.ndarray) -> bytes:
    return np.packbits(is_on, bitorder="little").tobytes()


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()
