"""The grid of a scene, on which the scene file and every file of a field must agree."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ddrecon.grid import Grid, Triple
from ddrecon.io.volumes.field import Field
from ddrecon.scene_file.load import SceneFile
from ddrecon.scene_file.problems import Problems


def agree_on_grid(scene_file: SceneFile, fields: Mapping[str, Field]) -> Grid:
    """The grid of the scene and of all `fields` of its files, which are by key.

    Raises SceneError with all that do not agree, or where nothing says what the grid is.
    """
    section, problems = scene_file.tree.volume, Problems()
    sizes: dict[str, tuple[int, int, int]] = {key: f.resolution for key, f in fields.items()}
    boxes = {key: _corners(f.bounds) for key, f in fields.items() if f.bounds is not None}
    if section.resolution is not None:
        sizes = {"volume.resolution": section.resolution} | sizes
    if section.bounds is not None:
        boxes = {"volume.bounds": (section.bounds.min, section.bounds.max)} | boxes
    for key, size in sizes.items():
        first = next(iter(sizes))
        if size != sizes[first]:
            problems.note(
                scene_file.refused(
                    key, f"has {_by(size)} cells in x, y, z, but {first} has {_by(sizes[first])}"
                )
            )
    for key, box in boxes.items():
        first = next(iter(boxes))
        if not _same_box(box, boxes[first]):
            problems.note(
                scene_file.refused(
                    key, f"its bounds are {_box(box)}, but {first} says {_box(boxes[first])}"
                )
            )
    for name, known in (("resolution", sizes), ("bounds", boxes)):
        if not known:
            problems.note(
                scene_file.refused(
                    "volume", f"missing key {name!r}, which no field file gives either"
                )
            )
    problems.raise_any()
    return Grid.from_xyz(next(iter(sizes.values())), *next(iter(boxes.values())))


def _corners(bounds: np.ndarray) -> tuple[Triple, Triple]:
    (lx, ly, lz), (ux, uy, uz) = bounds.tolist()
    return (lx, ly, lz), (ux, uy, uz)


def _same_box(one: tuple[Triple, Triple], other: tuple[Triple, Triple]) -> bool:
    """Whether the corners agree to a hundred-thousandth of the box's sides.

    Files may hold them in single precision.
    """
    tolerance = 1e-5 * (np.array(other[1]) - np.array(other[0]))
    return bool((np.abs(np.array(one) - np.array(other)) <= tolerance).all())


def _by(size: tuple[int, int, int]) -> str:
    return " x ".join(map(str, size))


def _box(box: tuple[Triple, Triple]) -> str:
    return " to ".join(f"({', '.join(f'{side:g}' for side in corner)})" for corner in box)
