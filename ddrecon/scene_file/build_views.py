"""The views section as cameras and target images; why a camera sees nothing of the volume."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, replace
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.cameras import (
    Camera,
    cast_rays,
    edge_places,
    image_places,
    look_at,
    pixel_width,
    project,
)
from ddrecon.errors import FormatError, Problems
from ddrecon.grid import Grid
from ddrecon.io.images.table import Image, read_image, read_mask
from ddrecon.lenses import distort, ray_through
from ddrecon.march.box import cross_box
from ddrecon.pictures.noise import Noise
from ddrecon.scene import View
from ddrecon.scene_file.load import SceneFile, require
from ddrecon.scene_file.maker import Maker
from ddrecon.scene_file.view_schema import CameraSection, PerspectiveSection, ViewSection

READERS: Mapping[str, Callable[[Path, int, float], Image]] = {
    "image": read_image,
    "background": read_image,
    "mask": read_mask,
}
"""What reads the pictures of a view, by their keys."""
SAME_UNIT = "are volume.bounds and the cameras in the same unit?"
USUAL = 0.3, 10.0
"""Pictures are so many times as wide as the box where cameras have its unit."""
CHECKED = 1000
"""Within an image, distortion is checked at so many places; and at all of its edges."""
COARSER = 8
MOST_PIXELS = 2**18
"""Images are made about this small before they are looked at closely."""


def build_views(maker: Maker, grid: Grid | None) -> list[View]:
    """The scene's views; where `grid` is known, cameras must see it.

    Raises SceneError or FormatError.
    """
    problems, views, sections = Problems(), list[View](), maker.tree.views
    for index in range(len(sections)):
        with problems.collecting():
            views.append(_build_view(maker, index))
    cameras = {view.name: view.camera for view in views}
    blind = [name for name in cameras if grid is not None and not sees_box(cameras[name], grid)]
    if grid is not None and blind:
        index = [section.name for section in sections].index(blind[0])
        more = f" and {len(blind) - 1} more" if len(blind) > 1 else ""
        why = explain_blindness([cameras[name] for name in blind], [*cameras.values()], grid)
        fault = f"no pixel of view {blind[0]!r}{more} looks through the volume; {why}"
        problems.note(maker.scene_file.refused(f"views.{index}.camera", fault))
    problems.raise_any()
    return views


def remove_pictures(scene_file: SceneFile, size: tuple[int, int] | None) -> SceneFile:
    """`scene_file` with views that have no pictures, of this `size` (width, height) where given.

    Raises SceneError where the size of one is not known without.
    """
    views = list[ViewSection]()
    for index, view in enumerate(scene_file.tree.views):
        camera = view.camera
        if size is None and camera.resolution is None:
            fault = "has no resolution but that of its picture; give one by --size W H"
            raise scene_file.refused(f"views.{index}.camera", fault)
        camera = replace(camera, resolution=size or camera.resolution)
        views.append(ViewSection(name=view.name, camera=camera, split=view.split))
    marks = {} if size is None else {"views": f"--size {size[0]} {size[1]}"}
    tree = replace(scene_file.tree, views=tuple(views))
    return replace(scene_file, tree=tree, marks={**scene_file.marks, **marks})


def _build_view(maker: Maker, index: int) -> View:
    key, section, problems = f"views.{index}", maker.tree.views[index], Problems()
    pictures, step = dict[str, Tensor](), 0.0
    for name, read in READERS.items():
        if isinstance(path := getattr(section, name), Path):
            with problems.collecting():
                require(maker.scene_file, f"{key}.{name}", path)
                is_still = name == "background"
                stored = read(path, 0, 0.0) if is_still else read(path, section.frame, section.time)
                pictures[name] = maker.picture(stored.pixels)
                step = stored.step if name == "image" else step
    image, resolution = pictures.get("image"), section.camera.resolution
    size = None if image is None else (image.shape[1], image.shape[2])
    if resolution is not None:
        size = resolution[1], resolution[0]
    for name, picture in pictures.items():
        if size is not None and tuple(picture.shape[1:]) != size:
            (height, width), (rows, columns) = picture.shape[1:], size
            fault = f"is {width} x {height} pixels, but {key}.camera has {columns} x {rows}"
            problems.note(FormatError(getattr(section, name), fault))
    if size is not None:
        with problems.collecting():
            camera = _build_camera(maker.scene_file, f"{key}.camera", section.camera, size)
            _require_unfolded(maker.scene_file, f"{key}.camera", camera)
    problems.raise_any()
    background = pictures.get("background")
    if background is None and isinstance(section.background, float | tuple):
        background = maker.tensor(section.background).view(-1, 1, 1)
    lens = None if camera.distortion is None else maker.tensor(camera.distortion)
    noise = section.noise
    return View(
        section.name,
        replace(camera, pose=maker.tensor(camera.pose), distortion=lens),
        image,
        pictures["mask"][0] if "mask" in pictures else None,
        section.split == "test",
        section.weight,
        None if section.exposure == 1 else maker.tensor(section.exposure).view(-1),
        None if section.offset == 0 else maker.tensor(section.offset).view(-1),
        background,
        step,
        None if noise is None else Noise(noise.read, noise.shot, step),
    )


def _build_camera(
    scene_file: SceneFile, key: str, section: CameraSection, size: tuple[int, int]
) -> Camera:
    """The camera in float64 on the CPU."""
    if section.matrix is not None:
        pose = torch.tensor(section.matrix, dtype=torch.float64)[:3]
    else:
        vectors = section.origin, section.target, section.up
        try:
            pose = look_at(*(torch.tensor(vector, dtype=torch.float64) for vector in vectors))
        except ValueError as error:
            raise scene_file.refused(key, str(error)) from error
    if not isinstance(section, PerspectiveSection):
        return Camera(pose, size, section.width / 2, False, pixel_aspect=section.pixel_aspect)
    lens = section.distortion
    return Camera(
        pose,
        size,
        math.tan(math.radians(section.fov) / 2),
        True,
        section.principal_point,
        section.pixel_aspect,
        None if lens is None else lens.type,
        None if lens is None else torch.tensor(astuple(lens), dtype=torch.float64),
    )


def _require_unfolded(scene_file: SceneFile, key: str, camera: Camera) -> None:
    """Raises SceneError where no light meets a pixel of `camera`: distortion folds over there."""
    if camera.lens is None or camera.distortion is None:
        return
    coarser = camera.resize(math.ceil(math.sqrt(camera.size[0] * camera.size[1] / CHECKED)))
    places = torch.cat([image_places(coarser), edge_places(camera)])
    seen = ray_through(camera.lens, camera.distortion, places)
    error = (distort(camera.lens, camera.distortion, seen) - places).abs()
    if not bool((error <= 1e-4 * (1 + places.abs())).all()):
        raise scene_file.refused(
            f"{key}.distortion",
            "folds over within the image: some pixels see no direction; "
            "check its coefficients and the focal length, or crop the picture",
        )


def sees_box(camera: Camera, grid: Grid) -> bool:
    """Whether any pixel of `camera` looks through the box of `grid`; a coarser image is tried
    first, because it is quick.
    """
    finer = max(1, math.ceil(math.sqrt(camera.size[0] * camera.size[1] / MOST_PIXELS)))
    return any(
        cross_box(grid, cast_rays(image)).hit.numel() > 0
        for image in (camera.resize(COARSER * finer), camera.resize(finer))
    )


CONVENTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "OpenCV axes (right, down, forward): negate the second and third column of each matrix": (
        lambda pose: pose * pose.new_tensor([1, -1, -1, 1])
    ),
    "world to camera: give the inverse of each matrix": lambda pose: _inverse(pose),
    "world to camera with OpenCV axes: give the inverse of each matrix, its second and third column"
    " negated": lambda pose: _inverse(pose) * pose.new_tensor([1, -1, -1, 1]),
    "z up, as in Blender, in a scene with y up: turn the cameras or volume.bounds": (
        lambda pose: pose.new_tensor([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ pose
    ),
    "y up in a scene with z up, as in Blender: turn the cameras or volume.bounds": (
        lambda pose: pose.new_tensor([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ pose
    ),
}
"""What poses may be instead of camera to world with OpenGL axes, and what makes these of them."""


def explain_blindness(blind: Sequence[Camera], cameras: Sequence[Camera], grid: Grid) -> str:
    """Why, most likely, none of the `blind` ones of a scene's `cameras` sees the box of `grid`.

    Others may see it by chance.
    """
    unit = _explain_unit(cameras, grid)
    if all(_looks_at(camera, grid) for camera in blind):
        return f"it is in the picture, but smaller than a pixel: {unit or SAME_UNIT}"
    for convention, convert in CONVENTIONS.items() if len(cameras) > 1 else ():
        turned = [replace(camera, pose=convert(camera.pose)) for camera in cameras]
        if all(_looks_at(camera, grid) for camera in turned):
            return f"it would with matrices read otherwise; they seem to be {convention}"
    if unit:
        return unit
    pose = blind[0].pose.double()
    is_behind = torch.dot(pose.new_tensor(grid.center_xyz) - pose[:, 3], -pose[:, 2]) < 0
    return (
        f"the camera looks {'away from' if is_behind else 'past'} it: check its target, field of"
        " view or width, and that volume.bounds has the units and axes of the cameras, whose"
        " matrices are camera to world with x right, y up and z backward (OpenGL's axes)"
    )


def _explain_unit(cameras: Sequence[Camera], grid: Grid) -> str:
    """By which factor on lengths all `cameras` would see the box at a usual size, if by any."""
    fits, middle = list[tuple[float, float]](), cameras[0].pose.new_tensor(grid.center_xyz)
    for times in (10.0**power for power in (-3, -2, -1, 1, 2, 3)):
        scale = middle.new_tensor([1, 1, 1, times])
        scaled = [replace(camera, pose=camera.pose * scale) for camera in cameras]
        widths = [pixel_width(c, middle) * c.size[1] for c in scaled if _looks_at(c, grid)]
        least, most = (end(widths, default=1.0) / math.dist(*grid.bounds_xyz) for end in (min, max))
        if len(widths) == len(cameras) and USUAL[0] < least <= most < USUAL[1]:
            fits.append((abs(math.log(least * most)), times))
    if not fits:
        return ""
    return f"it would be seen with lengths of the cameras times {min(fits)[1]:g}: {SAME_UNIT}"


def _inverse(pose: Tensor) -> Tensor:
    turned = pose[:, :3].T
    return torch.cat([turned, -turned @ pose[:, 3:]], 1)


def _looks_at(camera: Camera, grid: Grid) -> bool:
    """Whether the middle of the box of `grid` is in the image of `camera`."""
    center = camera.pose.new_tensor([grid.center_xyz])
    (column, row), _ = (values[0] for values in project(camera, center))
    height, width = camera.size
    return bool((column >= 0) & (column <= width) & (row >= 0) & (row <= height))
