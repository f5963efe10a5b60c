"""OpenVDB files (.vdb) of any program, read without OpenVDB.

Fog volumes are read: grids of half, float, double, and of vectors of three, on trees 5, 4, 3, in
files of the versions 220 to 225, compressed by zip, by Blosc or not at all. Level sets, points and
other trees are refused.

A grid's transform puts the center of voxel (i, j, k) in the world. Grids of a file that have the
same voxels share one box, around what is active in any of them, so that a scene can have several.
Where axes are exchanged or mirrored, cells are put in order along x, y and z; a grid that is turned
otherwise is resampled.
"""

from __future__ import annotations

import itertools
import re
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddrecon.errors import DataWarning, FormatError
from ddrecon.io.volumes.field import VECTORS, Field, check_field
from ddrecon.io.volumes.vdb_tree import (
    NODE_MASKS,
    NOWHERE,
    ZIP,
    Coding,
    Stream,
    Tree,
    check_box,
    join,
)

MAGIC, HEADER, UUID_LENGTH = 0x56444220, struct.Struct("<qIIIB"), 36
OLDEST, NEWEST = 220, 225
"""Versions of files that are read."""
POSITIONS = struct.Struct("<3q")
"""Where a grid begins, where its voxels do, and where it ends."""
RESOLUTION = "ddrecon_resolution"
"""Metadata of our own files: how many cells the box has, empty ones included."""
NUMBERS = {"half": "<f2", "float": "<f4", "double": "<f8", "vec3s": "<f4", "vec3d": "<f8"}
"""The numbers of a value, by its type."""
TREE = re.compile(f"Tree_({'|'.join(NUMBERS)})_5_4_3(_HalfFloat)?")
MAPS = {
    **dict.fromkeys(("UniformScaleMap", "ScaleMap"), 15),
    **dict.fromkeys(("UniformScaleTranslateMap", "ScaleTranslateMap"), 18),
    "TranslationMap": 3,
    **dict.fromkeys(("UnitaryMap", "AffineMap"), 16),
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
        self.path, self.stream = path, Stream(path)
        stream, size = self.stream, HEADER.size
        magic, self.version, *_, has_places = HEADER.unpack(stream.read(size))
        if magic != MAGIC:
            raise FormatError(path, "is no OpenVDB file")
        if not OLDEST <= self.version <= NEWEST:
            versions = f"{OLDEST} to {NEWEST} are read"
            raise FormatError(path, f"is of the file version {self.version}; {versions}")
        if not has_places:
            raise FormatError(path, "was written as a stream: save it as a file, by OpenVDB's File")
        self.flags = ZIP if self.version < NODE_MASKS and stream.read(1) != b"\0" else 0
        stream.read(UUID_LENGTH)
        stream.metadata()
        grids = (self._read_grid() for _ in range(*stream.unpack("<I")))
        self.grids = {grid.name: grid for grid in grids}

    def _read_grid(self) -> Grid:
        """The next grid, all but its tree."""
        stream = self.stream
        # Grids of the same name have numbers behind a separator of records.
        name, tree, parent = (re.sub("\x1e(.*)", r"[\1]", stream.text()) for _ in range(3))
        begin, _, end = stream.unpack(POSITIONS.format)
        if not stream.at <= begin <= end:
            raise ValueError(f"{name} begins at {begin} and ends at {end}")
        stream.at = begin
        (flags,) = stream.unpack("<I") if self.version >= NODE_MASKS else (self.flags,)
        labels, kind = stream.metadata(), stream.text()
        steps, origin = _read_map(stream, kind)
        begin, stream.at = stream.at, end
        coding = None
        if match := TREE.fullmatch(tree):
            number, is_half = np.dtype(NUMBERS[match[1]]), bool(match[2])
            stored = np.dtype("<f2") if is_half else number
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
        box = self.tree_of(grid).measure()
        cells = grid.labels.get(RESOLUTION, b"")
        if len(cells) == 12 and min(sides := struct.unpack("<3i", cells)) > 0:
            box = join(box, np.array([[0, 0, 0], sides]))
        return box

    def place(self, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """The box [2, 3] of voxels of all grids like `grid`, and the center [3] of its first.

        Raises FormatError where nothing is active, or the box takes too much memory.
        """
        shifts = {other.name: grid.shift(other) for other in self.grids.values()}
        same = {name: shift for name, shift in shifts.items() if shift is not None}
        box, is_motion = NOWHERE, grid.name.lower() in MOTION
        for name, shift in same.items():
            if is_motion or name.lower() not in MOTION:
                box = join(box, self.measure(self.grids[name]) + shift)
        if (box[0] >= box[1]).any():
            raise FormatError(self.path, f"{grid.name} has no active voxel")
        assert grid.coding is not None
        check_box(self.path, grid.name, box, grid.coding.components)
        # By the first grid's transform: rounding of their own must not tell them apart.
        first = self.grids[next(iter(same))]
        return box, first.origin + (box[0] - same[first.name]) @ first.steps


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
    axes = _find_axes(grid.steps)
    if axes is None:
        return _read_turned(file, grid, tree, box, center)
    order, signs = axes
    values = np.empty([*sides[order[::-1]], tree.coding.components], np.float32)
    # The same by index: its axes are exchanged, and run backward where a step does.
    by_index = values.transpose(2, 1, 0, 3)[tuple(slice(None, None, sign) for sign in signs)]
    tree.fill(by_index.transpose(*np.argsort(order), 3), box[0])
    corner = center - grid.steps.sum(0) / 2
    bounds = np.sort([corner, corner + sides @ grid.steps], axis=0)
    return check_field(path, name, values, bounds)


def _find_axes(steps: np.ndarray) -> tuple[np.ndarray, list[int]] | None:
    """Which index runs along x, y and z, and which way; None where `steps` are turned."""
    is_along = np.abs(steps) > UPRIGHT * np.abs(steps).max(1, keepdims=True)
    if (is_along.sum(0) != 1).any() or (is_along.sum(1) != 1).any():
        return None
    order = is_along.argmax(0)
    return order, [int(np.sign(steps[index, axis])) for axis, index in enumerate(order)]


def _read_turned(file: _File, grid: Grid, tree: Tree, box: np.ndarray, center: np.ndarray) -> Field:
    """The `tree` of a turned `grid`, of which `box` has its first voxel at `center`, resampled.

    In an upright box around it, in cubes of its shortest step, by trilinear interpolation.
    """
    corners = np.array(list(itertools.product(*np.stack([[-0.5] * 3, box[1] - box[0] - 0.5], 1))))
    corners = center + corners @ grid.steps
    extent, side = np.ptp(corners, axis=0), np.linalg.norm(grid.steps, axis=1).min()
    cells = np.maximum(1, np.ceil(extent / side - SAME_PLACE)).astype(int)
    middle = (corners.min(0) + corners.max(0)) / 2
    bounds = middle + side * np.stack([-cells, cells]) / 2
    check_box(file.path, grid.name, np.stack([0 * cells, cells]), tree.coding.components)
    size = " x ".join(map(str, cells))
    text = f"{grid.name} is turned; resampled to {size} cubes of {side:.4g} u along x, y, z"
    warnings.warn(f"{file.path}: {text}", DataWarning, 2)
    # A voxel of background around it is what lies beyond.
    source = np.empty([*(box[1] - box[0] + 2), tree.coding.components], np.float32)
    tree.fill(source, box[0] - 1)
    x, y, z = (bounds[0, axis] + side * (np.arange(cells[axis]) + 0.5) for axis in range(3))
    values = np.empty([*cells[::-1], source.shape[3]], np.float32)
    to_index, last = np.linalg.inv(grid.steps), np.array(source.shape[:3]) - 1
    for layer, height in zip(values, z, strict=True):
        centers = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), height)], -1)
        index = np.clip((centers - center) @ to_index + 1, 0, last)
        first = np.minimum(index.astype(int), last - 1)
        layer[:] = 0
        for corner in itertools.product((0, 1), repeat=3):
            weight = np.abs(1 - np.array(corner) - (index - first)).prod(-1, keepdims=True)
            layer += weight * source[tuple(np.moveaxis(first + corner, -1, 0))]
    return check_field(file.path, grid.name, values, bounds)
