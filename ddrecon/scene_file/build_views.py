"""The views section as cameras and target images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.io.images.table import read_image, read_mask
from ddrecon.scene import View
from ddrecon.scene_file.files import read_referenced
from ddrecon.scene_file.load import SceneFile
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.schema import CameraSection, PerspectiveSection
from ddrecon.scene_file.sight import explain_blindness, explain_direction, sees_box

NAMED = 4
"""Views that a line about several names."""


def build_views(
    scene_file: SceneFile, grid: Grid | None, dtype: torch.dtype, device: torch.device
) -> list[View]:
    """The scene's views in `dtype` on `device`.

    Where `grid` is known, cameras must see it. Raises SceneError or FormatError.
    """
    problems, cameras, views = Problems(), dict[int, Camera](), []
    for index in range(len(scene_file.tree.views)):
        with problems.collecting():
            views.append(_build_view(scene_file, index, cameras, dtype, device))
    if grid is not None:
        with problems.collecting():
            _require_sight(scene_file, cameras, grid)
    problems.raise_any()
    return views


def _require_sight(scene_file: SceneFile, cameras: Mapping[int, Camera], grid: Grid) -> None:
    """Raises SceneError where some of `cameras`, by the place of their view, do not see the box.

    They share a line, since they mostly share a cause.
    """
    seeing = {index: sees_box(camera, grid) for index, camera in cameras.items()}
    blind = [index for index, sees in seeing.items() if not sees]
    if not blind:
        return
    views = scene_file.tree.views
    by_matrix = [index for index in cameras if views[index].camera.matrix is not None]
    others = [cameras[index] for index in by_matrix if seeing[index]]
    explain = explain_direction
    if set(blind) <= set(by_matrix):
        explain = partial(explain_blindness, others=others)
    names = [repr(views[index].name) for index in blind]
    which = f"view {names[0]}"
    if len(names) > 1:
        rest = ", ..." if len(names) > NAMED else ""
        which = f"{len(names)} of {len(views)} views ({', '.join(names[:NAMED])}{rest})"
    cause = explain([cameras[index] for index in blind], grid=grid)
    raise scene_file.refused(
        f"views.{blind[0]}.camera", f"no pixel of {which} looks through the volume; {cause}"
    )


def _build_view(
    scene_file: SceneFile,
    index: int,
    cameras: dict[int, Camera],
    dtype: torch.dtype,
    device: torch.device,
) -> View:
    """The view number `index`; its camera, on the CPU, is put into `cameras`."""
    key, section, problems = f"views.{index}", scene_file.tree.views[index], Problems()
    image = mask = None
    if section.image is not None:
        with problems.collecting():
            pixels = read_referenced(scene_file, f"{key}.image", section.image, read_image).pixels
            image = torch.from_numpy(pixels).permute(2, 0, 1).contiguous().to(device, dtype)
    if section.mask is not None:
        with problems.collecting():
            mask = torch.from_numpy(
                read_referenced(scene_file, f"{key}.mask", section.mask, read_mask)
            ).to(device, dtype)
    size = _size(section.camera, image)
    for name, picture in (("image", image), ("mask", mask)):
        if picture is not None and size is not None and tuple(picture.shape[-2:]) != size:
            height, width = picture.shape[-2:]
            problems.note(
                scene_file.refused(
                    f"{key}.{name}",
                    f"is {width} x {height} pixels, but the camera has {size[1]} x {size[0]}",
                )
            )
    if size is not None:
        with problems.collecting():
            camera = _build_camera(scene_file, f"{key}.camera", section.camera, size)
            cameras[index] = camera
    problems.raise_any()
    camera = replace(camera, pose=camera.pose.to(device, dtype))
    return View(section.name, camera, image, mask, section.split == "test", section.weight)


def _size(camera: CameraSection, image: Tensor | None) -> tuple[int, int] | None:
    """(height, width): what the scene says, else the image's; None if that could not be read."""
    if camera.resolution is not None:
        return camera.resolution[1], camera.resolution[0]
    return None if image is None else (image.shape[1], image.shape[2])


def _build_camera(
    scene_file: SceneFile, key: str, section: CameraSection, size: tuple[int, int]
) -> Camera:
    """The camera in float64 on the CPU."""
    try:
        pose = _pose(section)
    except ValueError as error:
        raise scene_file.refused(key, str(error)) from error
    if isinstance(section, PerspectiveSection):
        return Camera(
            pose,
            size,
            math.tan(math.radians(section.fov) / 2),
            True,
            section.principal_point,
            section.pixel_aspect,
        )
    return Camera(pose, size, section.width / 2, is_perspective=False)


def _pose(section: CameraSection) -> Tensor:
    if section.matrix is not None:
        return torch.tensor(section.matrix, dtype=torch.float64)[:3]
    return look_at(
        *(
            torch.tensor(vector, dtype=torch.float64)
            for vector in (section.origin, section.target, section.up)
        )
    )
