"""The views of a scene as a `transforms.json`, which NeRF, instant-ngp and nerfstudio read."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ddrecon.errors import SceneError
from ddrecon.io.files.folders import require_free_files
from ddrecon.io.files.json_file import write_json
from ddrecon.scene import Scene, View
from ddrecon.scene_file.load import SceneFile
from ddrecon.settings import LENSES

NAMES = {"opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
"""What lenses are called there."""


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
