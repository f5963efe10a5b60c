"""The camera of one frame of a `transforms.json`, with its lens.

Its intrinsics are in pixels, or it has an angle of view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ddrecon.scene_file.camera_schema import (
    FisheyeSection,
    LensSection,
    Matrix,
    OpencvSection,
    PerspectiveSection,
    Size,
)
from ddrecon.scene_file.leaves import Rule, read_matrix, read_number, read_text
from ddrecon.scene_file.nodes import Node
from ddrecon.settings import LENSES

OPENCV = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
"""Camera models whose distortion is OpenCV's, as far as they have some."""
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
REMEDY = "undistort the pictures first (COLMAP: image_undistorter) and give the cameras they get"
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "k5", "k6")
Entries = Mapping[str, Node]


def read_camera(frame: Node, entries: Entries, rule: Rule) -> PerspectiveSection:
    """The camera that `entries` describe, those of `frame` and of its file.

    Raises SceneError for what is wrong.
    """
    if "transform_matrix" not in entries:
        raise frame.refused("missing key 'transform_matrix'")
    matrix = read_matrix(entries["transform_matrix"], Rule(Matrix, {}, rule.folder))
    lens = _intrinsics(frame, entries, rule)
    lens["distortion"] = _distortion(entries, rule)
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


def _distortion(entries: Entries, rule: Rule) -> LensSection | None:
    """The lens; None for a pinhole. Raises SceneError for a model that is not known."""
    model = read_text(entries["camera_model"], rule).upper() if "camera_model" in entries else ""
    if model and model not in (*OPENCV, *FISHEYE):
        raise entries["camera_model"].refused(
            f"{entries['camera_model'].value} is a lens that is not modeled; {REMEDY}"
        )
    is_fisheye = model in FISHEYE or ("is_fisheye" in entries and bool(entries["is_fisheye"].value))
    section = FisheyeSection if is_fisheye else OpencvSection
    given = {name: read_number(entries[name], rule) for name in COEFFICIENTS if name in entries}
    if "distortion_params" in entries:
        # nerfstudio: k1, k2, k3, k4, p1, p2
        nodes = entries["distortion_params"].children()
        given |= dict(zip(COEFFICIENTS, (read_number(node, rule) for node in nodes), strict=False))
    known = LENSES[section.type]
    for name, value in given.items():
        if name not in known and value != 0:
            source = entries[name if name in entries else "distortion_params"]
            raise source.refused(f"{name} = {value:g} is not modeled; {REMEDY}")
    lens = {name: value for name, value in given.items() if name in known}
    return section(**lens) if is_fisheye or any(lens.values()) else None
