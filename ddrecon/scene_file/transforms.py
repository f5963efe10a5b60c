"""Camera files of NeRF, instant-ngp and nerfstudio (`transforms.json`), read and written.

What a frame says takes precedence over what the file says. Poses are camera to world with OpenGL
axes and stay as they stand: what tells other programs how to map them into a box of their own
(`scale`, `offset`, `aabb_scale`, `applied_transform`) is not for us. Intrinsics are in pixels, or
there is an angle of view.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ddrecon.errors import FormatError, SceneError
from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.folders import require_free_files
from ddrecon.scene_file.nodes import Node
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.read import read_as
from ddrecon.scene_file.schema import (
    FisheyeSection,
    LensSection,
    Matrix,
    OpencvSection,
    PerspectiveSection,
    ViewSection,
    split_views,
)
from ddrecon.settings import LENSES

if TYPE_CHECKING:
    from ddrecon.scene import Scene, View
    from ddrecon.scene_file.load import SceneFile

MAX_BYTES = 64 * 2**20
TEST_NAME = re.compile(r"(?<![a-z])(test|val)(?![a-z])", re.IGNORECASE)
TRAIN_NAME = re.compile(r"(?<![a-z])train(?![a-z])", re.IGNORECASE)
LISTS = ("train_filenames", "test_filenames", "val_filenames")
OPENCV = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
"""Camera models whose distortion is OpenCV's, as far as they have some."""
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
REMEDY = "undistort the pictures first (COLMAP: image_undistorter) and give the cameras they get"
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "k5", "k6")
NAMES = {"opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
"""What lenses are called there."""
Entries = Mapping[str, Node]


def read_transforms(
    node: Node, paths: Sequence[Path], test_every: int | None
) -> tuple[ViewSection, ...]:
    """The views in the files `paths`, which `node` of a scene names, still without names.

    A file that does not say which are test views has one in `test_every`. Raises SceneError or
    FormatError.
    """
    problems, views = Problems(), list[ViewSection]()
    for path in paths:
        with problems.collecting():
            document = _document(node, path)
            try:
                views += _file_views(document, path, test_every)
            except SceneError as error:
                first, *others = error.problems
                raise FormatError(path, first.removeprefix(f"{path}: "), others) from error
    problems.raise_any()
    return tuple(views)


def _document(node: Node, path: Path) -> Node:
    if not path.is_file():
        raise node.refused(f"{path} does not exist, or is not a file")
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FormatError(
                path, f"is larger than {MAX_BYTES // 2**20} MiB; it holds more than cameras"
            )
        return _node("", str(path), json.loads(path.read_bytes(), parse_int=_whole))
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise FormatError(path, f"not JSON: {error}") from error


def _whole(digits: str) -> int | float:
    """A whole number; infinite where no arithmetic could be done with it."""
    return int(digits) if len(digits) < 300 else float(digits)


def _node(key: str, where: str, value: Any) -> Node:
    """`value`, as JSON has it, as a node at `key` and all those below it."""
    node = Node(key, where, where, value)
    if isinstance(value, dict):
        node.value = {name: _node(node.child_key(name), where, one) for name, one in value.items()}
    elif isinstance(value, list):
        node.value = [_node(node.child_key(index), where, one) for index, one in enumerate(value)]
    return node


def _file_views(root: Node, path: Path, test_every: int | None) -> list[ViewSection]:
    if not isinstance(root.value, dict) or "frames" not in root.value:
        raise root.refused(
            "has no 'frames'; expected a transforms.json as of NeRF, instant-ngp or nerfstudio"
        )
    frames, folder = root.value["frames"], path.absolute().parent
    if not isinstance(frames.value, list) or not frames.value:
        raise frames.refused("expected a list with at least one frame")
    splits = _listed_splits(root, frames.value)
    problems, views = Problems(), []
    for frame, split in zip(frames.value, splits or frames.value, strict=True):
        if split is not None:
            with problems.collecting():
                views.append(_frame_view(frame, root.value, folder))
    problems.raise_any()
    if splits:
        kept = filter(None, splits)
        return [replace(view, split=split) for view, split in zip(views, kept, strict=True)]
    if is_test := TEST_NAME.search(path.stem) or TRAIN_NAME.search(path.stem):
        test_every = 1 if is_test.re is TEST_NAME else None
    return split_views(views, test_every)


def _listed_splits(root: Node, frames: Sequence[Node]) -> list[str | None]:
    """The split of each frame by the lists of the file, where it has any.

    It is None for one that they leave out, as nerfstudio does.
    """
    entries = root.entries()
    if not any(name in entries for name in LISTS):
        return []
    names = [_name(frame) for frame in frames]
    train, test, val = (_listed(entries.get(name), names) for name in LISTS)
    is_open = "train_filenames" not in entries
    splits = [
        "test" if name in test | val else "train" if is_open or name in {*train, None} else None
        for name in names
    ]
    if not any(splits):
        raise root.refused("its lists of files name no frame")
    return splits


def _name(frame: Node) -> Path | None:
    """What lists call the `frame`, if anything."""
    name = frame.value.get("file_path") if isinstance(frame.value, dict) else None
    return Path(name.value) if name is not None and isinstance(name.value, str) else None


def _listed(node: Node | None, names: Sequence[Path | None]) -> set[Path]:
    """The frames that a list of the file names; raises SceneError for one that there is not."""
    listed = set()
    for entry in node.children() if node is not None else ():
        name = Path(read_as(entry, str, Path()))
        if name not in names:
            raise entry.refused(f"no frame has the file_path {entry.value!r}")
        listed.add(name)
    return listed


def _frame_view(frame: Node, shared: Entries, folder: Path) -> ViewSection:
    """The view of a `frame` of a file in `folder`, whose `shared` entries hold for all frames."""
    own = frame.entries()
    image, mask = (
        read_as(own[name], Path, folder) if name in own else None
        for name in ("file_path", "mask_path")
    )
    camera = _read_camera(frame, {**shared, **own}, folder)
    if image is None and camera.resolution is None:
        raise frame.refused(
            "has neither file_path nor w and h, so that its number of pixels is unknown"
        )
    return ViewSection(camera=camera, image=image and _with_suffix(image), mask=mask)


def _with_suffix(image: Path) -> Path:
    """The frame's `image`, a .png where its name has no suffix of an image."""
    from ddrecon.io.images.table import READERS

    return image if image.suffix.lower() in READERS else image.with_name(f"{image.name}.png")


def _read_camera(frame: Node, entries: Entries, folder: Path) -> PerspectiveSection:
    """The camera that `entries` describe, those of `frame` and of its file.

    Raises SceneError for what is wrong.
    """
    if "transform_matrix" not in entries:
        raise frame.refused("missing key 'transform_matrix'")
    matrix = read_as(entries["transform_matrix"], Matrix, folder)
    lens = _intrinsics(frame, entries)
    lens["distortion"] = _distortion(entries)
    camera = PerspectiveSection(matrix=matrix, **lens)
    for _, what in camera.violations():
        raise entries["transform_matrix"].refused(what)
    return camera


def _intrinsics(frame: Node, entries: Entries) -> dict[str, Any]:
    """`fov`, and where the image's size is known, the rest that a camera needs.

    That is `resolution`, `principal_point` and `pixel_aspect`.
    """

    def number(name: str, **limits: float) -> float | None:
        return read_as(entries[name], float, Path(), **limits) if name in entries else None

    angle_x, angle_y = (number(f"camera_angle_{axis}", above=0, below=math.pi) for axis in "xy")
    focal_x, focal_y = (number(f"fl_{axis}", above=0) for axis in "xy")
    if focal_x is None and angle_x is None:
        raise frame.refused("has neither fl_x nor camera_angle_x")
    width, height = (number(name, minimum=1, maximum=16384) for name in ("w", "h"))
    if width is None or height is None:
        if needing := [name for name in ("fl_x", "fl_y", "cx", "cy") if name in entries]:
            raise entries[needing[0]].refused(
                "is in pixels, but w and h do not say how many there are"
            )
        return {"fov": math.degrees(angle_x or 0)}
    for name, side in (("w", width), ("h", height)):
        if not side.is_integer():
            raise entries[name].refused(f"expected a whole number, found {side:g}")
    focal_x = focal_x or width / 2 / math.tan((angle_x or 0) / 2)
    focal_y = focal_y or (height / 2 / math.tan(angle_y / 2) if angle_y else focal_x)
    x, y = number("cx"), number("cy")
    return {
        "fov": 2 * math.degrees(math.atan(width / 2 / focal_x)),
        "resolution": (int(width), int(height)),
        "principal_point": (0.5 if x is None else x / width, 0.5 if y is None else y / height),
        "pixel_aspect": focal_x / focal_y,
    }


def _distortion(entries: Entries) -> LensSection | None:
    """The lens; None for a pinhole. Raises SceneError for a model that is not known."""
    model = ""
    if "camera_model" in entries:
        model = read_as(entries["camera_model"], str, Path()).upper()
        if model not in (*OPENCV, *FISHEYE):
            raise entries["camera_model"].refused(
                f"{entries['camera_model'].value} is a lens that is not modeled; {REMEDY}"
            )
    is_fisheye = model in FISHEYE or ("is_fisheye" in entries and bool(entries["is_fisheye"].value))
    section = FisheyeSection if is_fisheye else OpencvSection
    given = {name: entries[name] for name in COEFFICIENTS if name in entries}
    if "distortion_params" in entries:
        # nerfstudio: k1, k2, k3, k4, p1, p2
        given |= dict(zip(COEFFICIENTS, entries["distortion_params"].children(), strict=False))
    lens = {name: read_as(node, float, Path()) for name, node in given.items()}
    for name in set(lens) - set(LENSES[section.type]):
        if (value := lens.pop(name)) != 0:
            raise given[name].refused(f"{name} = {value:g} is not modeled; {REMEDY}")
    return section(**lens) if is_fisheye or any(lens.values()) else None


def export_transforms(
    scene: Scene, scene_file: SceneFile, path: Path, *, may_exist: bool
) -> list[Path]:
    """Writes the views of `scene`, read from `scene_file`, to `path`, and returns what was written.

    Images and masks are named relative to it; a view without an image has no `file_path`. Raises
    UsageError where `path` exists and may not or its folder is missing, SceneError for views in
    parallel projection.
    """
    require_free_files([path], may_exist=may_exist)
    frames = []
    for view, section in zip(scene.views, scene_file.tree.views, strict=True):
        files = {"file_path": section.image, "mask_path": section.mask}
        frames.append(
            {key: _relative(file, path) for key, file in files.items() if file is not None}
            | _camera(view)
        )
    models = {frame.get("camera_model", "PINHOLE") for frame in frames}
    model = models.pop() if len(models) == 1 else "PINHOLE"
    write_json(path, {"camera_model": model, **_splits(scene.views, frames), "frames": frames})
    return [path]


def _relative(file: Path, path: Path) -> str:
    return Path(os.path.relpath(file, path.absolute().parent)).as_posix()


def _camera(view: View) -> dict[str, Any]:
    camera = view.camera
    if not camera.is_perspective:
        raise SceneError(
            f"view {view.name!r}: an orthographic camera has no place in a transforms.json"
        )
    (height, width), (x, y) = camera.size, camera.principal_point
    focal = width / 2 / float(camera.half_width)
    intrinsics: dict[str, Any] = {
        "w": width,
        "h": height,
        "fl_x": focal,
        "fl_y": focal / camera.pixel_aspect,
        "cx": float(x) * width,
        "cy": float(y) * height,
    }
    if camera.lens is not None and camera.distortion is not None:
        coefficients = zip(LENSES[camera.lens], camera.distortion.tolist(), strict=True)
        intrinsics |= {"camera_model": NAMES[camera.lens]} | dict(coefficients)
    return intrinsics | {"transform_matrix": [*camera.pose.tolist(), [0.0, 0.0, 0.0, 1.0]]}


def _splits(views: list[View], frames: list[dict[str, Any]]) -> dict[str, list[str]]:
    """Which images are trained on and which are not, where some are not, in nerfstudio's words."""
    if not any(view.is_test for view in views):
        return {}
    named = [
        (frame["file_path"], view.is_test)
        for frame, view in zip(frames, views, strict=True)
        if "file_path" in frame
    ]
    train, test = ([name for name, is_test in named if is_test == kind] for kind in (False, True))
    return {"train_filenames": train, "val_filenames": test, "test_filenames": test}
