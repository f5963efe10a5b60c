"""The camera of one frame of a `transforms.json`: a pinhole.

Its intrinsics are in pixels, or it has an angle of view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ddrecon.scene_file.leaves import Rule, read_matrix, read_number, read_text
from ddrecon.scene_file.nodes import Node
from ddrecon.scene_file.schema import Matrix, PerspectiveSection, Size

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
"""Camera models that are pinholes where they have no distortion."""
REMEDY = (
    "undistort the pictures first (COLMAP: image_undistorter) and give the cameras of the results"
)
Entries = Mapping[str, Node]


def read_camera(frame: Node, entries: Entries, rule: Rule) -> PerspectiveSection:
    """The camera that `entries` describe, those of `frame` and of its file.

    Raises SceneError for what is wrong or distorted.
    """
    _require_pinhole(entries, rule)
    if "transform_matrix" not in entries:
        raise frame.refused("missing key 'transform_matrix'")
    matrix = read_matrix(entries["transform_matrix"], Rule(Matrix, {}, rule.folder))
    lens = _intrinsics(frame, entries, rule)
    camera = PerspectiveSection(matrix=matrix, **lens)  # type: ignore[arg-type]
    for _, what in camera.problems():
        raise entries["transform_matrix"].refused(what)
    return camera


def _intrinsics(frame: Node, entries: Entries, rule: Rule) -> dict[str, Any]:
    """`fov`, and where the image's size is known, the rest that a camera needs.

    That is `resolution`, `principal_point` and `pixel_aspect`.
    """
    angle_x, angle_y = (
        _number(entries, f"camera_angle_{axis}", rule, above=0, below=math.pi) for axis in "xy"
    )
    focal_x, focal_y = (_number(entries, f"fl_{axis}", rule, above=0) for axis in "xy")
    if focal_x is None and angle_x is None:
        raise frame.refused("has neither fl_x nor camera_angle_x")
    size = _size(entries, rule)
    if size is None:
        if needing := [name for name in ("fl_x", "fl_y", "cx", "cy") if name in entries]:
            raise entries[needing[0]].refused(
                "is in pixels, but w and h do not say how many there are"
            )
        return {"fov": math.degrees(angle_x or 0)}
    width, height = size
    focal_x = focal_x or width / 2 / math.tan((angle_x or 0) / 2)
    focal_y = focal_y or (height / 2 / math.tan(angle_y / 2) if angle_y else focal_x)
    x, y = (_number(entries, name, rule) for name in ("cx", "cy"))
    middle = (0.5 if x is None else x / width, 0.5 if y is None else y / height)
    fov = 2 * math.degrees(math.atan(width / 2 / focal_x))
    return {
        "fov": fov,
        "resolution": size,
        "principal_point": middle,
        "pixel_aspect": focal_x / focal_y,
    }


def _number(entries: Entries, name: str, rule: Rule, **limits: float) -> float | None:
    return read_number(entries[name], Rule(float, limits, rule.folder)) if name in entries else None


def _size(entries: Entries, rule: Rule) -> Size | None:
    width, height = (_number(entries, name, rule, minimum=1, maximum=16384) for name in ("w", "h"))
    if width is None or height is None:
        return None
    for name, side in (("w", width), ("h", height)):
        if not side.is_integer():
            raise entries[name].refused(f"expected a whole number, found {side:g}")
    return int(width), int(height)


def _require_pinhole(entries: Entries, rule: Rule) -> None:
    """Raises SceneError for cameras that are not pinholes."""
    if (
        "camera_model" in entries
        and read_text(entries["camera_model"], rule).upper() not in PINHOLES
    ):
        raise entries["camera_model"].refused(
            f"{entries['camera_model'].value} is no pinhole camera; {REMEDY}"
        )
    if "is_fisheye" in entries and entries["is_fisheye"].value:
        raise entries["is_fisheye"].refused(f"a fisheye is no pinhole camera; {REMEDY}")
    terms = [entries[name] for name in DISTORTION if name in entries]
    terms += entries["distortion_params"].children() if "distortion_params" in entries else []
    for term in terms:
        if read_number(term, rule) != 0:
            raise term.refused(
                f"{term.value:g} is a lens distortion, which is not modeled; {REMEDY}"
            )
