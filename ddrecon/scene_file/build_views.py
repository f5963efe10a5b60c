"""The views section as cameras and target images."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.cameras import Camera, look_at
from ddrecon.grid import Grid
from ddrecon.io.images.table import Image, read_image, read_mask
from ddrecon.pictures.noise import Noise
from ddrecon.scene import View
from ddrecon.scene_file.files import read_referenced
from ddrecon.scene_file.load import SceneFile
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.schema import CameraSection, Color, PerspectiveSection
from ddrecon.scene_file.sight import explain_blindness, sees_box


def build_views(
    scene_file: SceneFile, grid: Grid | None, dtype: torch.dtype, device: torch.device
) -> list[View]:
    """The scene's views in `dtype` on `device`.

    Where `grid` is known, cameras must see it. Raises SceneError or FormatError.
    """
    problems, views = Problems(), []
    for index in range(len(scene_file.tree.views)):
        with problems.collecting():
            views.append(_build_view(scene_file, index, grid, dtype, device))
    problems.raise_any()
    return views


def _build_view(
    scene_file: SceneFile, index: int, grid: Grid | None, dtype: torch.dtype, device: torch.device
) -> View:
    key, section, problems = f"views.{index}", scene_file.tree.views[index], Problems()
    image = mask = background = None
    step = 0.0
    if section.image is not None:
        with problems.collecting():
            stored = read_referenced(scene_file, f"{key}.image", section.image, read_image)
            image, step = _pixels(stored, dtype, device), stored.step
    if isinstance(section.background, Path):
        with problems.collecting():
            stored = read_referenced(
                scene_file, f"{key}.background", section.background, read_image
            )
            background = _pixels(stored, dtype, device)
    if section.mask is not None:
        with problems.collecting():
            mask = torch.from_numpy(
                read_referenced(scene_file, f"{key}.mask", section.mask, read_mask)
            ).to(device, dtype)
    size = _size(section.camera, image)
    for name, picture in (("image", image), ("mask", mask), ("background", background)):
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
            if grid is not None and not sees_box(camera, grid):
                raise scene_file.refused(
                    f"{key}.camera",
                    f"no pixel of view {section.name!r} looks through the volume;"
                    f" {explain_blindness(camera, grid)}",
                )
    problems.raise_any()
    camera = replace(camera, pose=camera.pose.to(device, dtype))
    if section.background is not None and not isinstance(section.background, Path):
        background = torch.tensor(section.background, dtype=dtype, device=device).view(-1, 1, 1)
    noise = section.noise

    def color(value: Color, default: float) -> Tensor | None:
        """[1] or [3], None where it is the default."""
        tensor = torch.tensor(value, dtype=dtype, device=device).view(-1)
        return None if value == default else tensor

    return View(
        section.name,
        camera,
        image,
        mask,
        section.split == "test",
        section.weight,
        color(section.exposure, 1.0),
        color(section.offset, 0.0),
        background,
        step,
        None if noise is None else Noise(noise.read, noise.shot, step),
    )


def _pixels(image: Image, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The pixels of `image`, [3, h, w]."""
    return torch.from_numpy(image.pixels).permute(2, 0, 1).contiguous().to(device, dtype)


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
