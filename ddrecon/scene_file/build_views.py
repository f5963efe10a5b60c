"""The views section as cameras and target images; why a camera sees nothing of the volume."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, replace
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.cameras import Camera, cast_rays, image_places, look_at, project
from ddrecon.errors import FormatError
from ddrecon.grid import Grid
from ddrecon.io.images.table import Image, read_image, read_mask
from ddrecon.lenses import is_folded
from ddrecon.march.box import cross_box
from ddrecon.pictures.noise import Noise
from ddrecon.scene import View
from ddrecon.scene_file.load import SceneFile, read_referenced
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.schema import CameraSection, Color, LensSection, PerspectiveSection

NAMED = 4
"""Views that a line about several names."""
LATTICE = 33
"""Pixels along each side of an image at which its distortion is checked."""
COARSER = 8
MOST_PIXELS = 2**18
"""Images are made about this small before they are looked at closely."""


def build_views(
    scene_file: SceneFile, grid: Grid | None, dtype: torch.dtype, device: torch.device
) -> list[View]:
    """The scene's views in `dtype` on `device`.

    Where `grid` is known, cameras must see it. Raises SceneError or FormatError.
    """
    problems, views = Problems(), []
    for index in range(len(scene_file.tree.views)):
        with problems.collecting():
            views.append(_build_view(scene_file, index, dtype, device))
    if grid is not None:
        _note_blind(scene_file, views, grid, problems)
    problems.raise_any()
    return views


def _note_blind(
    scene_file: SceneFile, views: Sequence[View], grid: Grid, problems: Problems
) -> None:
    """Notes the `views` that do not see the box of `grid`, in one line: they share a cause."""
    seeing = [sees_box(view.camera, grid) for view in views]
    blind = [view for view, sees in zip(views, seeing, strict=True) if not sees]
    if not blind:
        return
    others = [view.camera for view, sees in zip(views, seeing, strict=True) if sees]
    sections = scene_file.tree.views
    index = [section.name for section in sections].index(blind[0].name)
    key, which = f"views.{index}.camera", f"no pixel of view {blind[0].name!r}"
    if len(blind) > 1:
        named = ", ".join(repr(view.name) for view in blind[:NAMED])
        rest = ", ..." if len(blind) > NAMED else ""
        which = f"no pixel of {len(blind)} of {len(sections)} views ({named}{rest})"
    if len(blind) == len(sections) > 1:
        key, which = "views", "none"
    why = explain_blindness([view.camera for view in blind], grid, others)
    problems.note(scene_file.refused(key, f"{which} looks through the volume; {why}"))


def _build_view(
    scene_file: SceneFile, index: int, dtype: torch.dtype, device: torch.device
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
    if size is not None:
        paths = section.image, section.mask, section.background
        for path, picture in zip(paths, (image, mask, background), strict=True):
            if picture is not None and tuple(picture.shape[-2:]) != size:
                wrong = f"is {_by(picture.shape[-2:])} pixels, but {key}.camera has {_by(size)}"
                problems.note(FormatError(path, wrong))
        with problems.collecting():
            camera = _build_camera(scene_file, f"{key}.camera", section.camera, size)
            _require_unfolded(scene_file, f"{key}.camera", camera)
    problems.raise_any()
    lens = camera.distortion
    camera = replace(
        camera,
        pose=camera.pose.to(device, dtype),
        distortion=None if lens is None else lens.to(device, dtype),
    )
    if section.background is not None and not isinstance(section.background, Path):
        background = torch.tensor(section.background, dtype=dtype, device=device).view(-1, 1, 1)

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
        None if section.noise is None else Noise(section.noise.read, section.noise.shot, step),
    )


def _pixels(image: Image, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The pixels of `image`, [3, h, w]."""
    return torch.from_numpy(image.pixels).permute(2, 0, 1).contiguous().to(device, dtype)


def _size(camera: CameraSection, image: Tensor | None) -> tuple[int, int] | None:
    """(height, width): what the scene says, else the image's; None if that could not be read."""
    if camera.resolution is not None:
        return camera.resolution[1], camera.resolution[0]
    return None if image is None else (image.shape[1], image.shape[2])


def _by(size: Sequence[int]) -> str:
    return f"{size[1]} x {size[0]}"


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
            *_lens(section.distortion),
        )
    return Camera(pose, size, section.width / 2, False, pixel_aspect=section.pixel_aspect)


def _lens(section: LensSection | None) -> tuple[str | None, Tensor | None]:
    """The model of a lens and its coefficients, float64."""
    if section is None:
        return None, None
    return section.type, torch.tensor(astuple(section), dtype=torch.float64)


def _require_unfolded(scene_file: SceneFile, key: str, camera: Camera) -> None:
    """Raises SceneError where the distortion of `camera` folds over within the image."""
    if camera.lens is None or camera.distortion is None:
        return
    # The corners of a coarse lattice of pixels, those of the image among them.
    rows, columns = (torch.linspace(0, side - 1, LATTICE).long() for side in camera.size)
    places = image_places(camera).view(*camera.size, 2)[rows][:, columns].flatten(0, 1)
    folded = is_folded(camera.lens, camera.distortion, places)
    if bool(folded.any()):
        y, x = divmod(int(folded.nonzero()[0]), LATTICE)
        raise scene_file.refused(
            f"{key}.distortion",
            f"folds over within the image: no one direction is seen at pixel ({int(columns[x])},"
            f" {int(rows[y])}); check its coefficients and the focal length, or crop the picture",
        )


def _pose(section: CameraSection) -> Tensor:
    if section.matrix is not None:
        return torch.tensor(section.matrix, dtype=torch.float64)[:3]
    return look_at(
        *(
            torch.tensor(vector, dtype=torch.float64)
            for vector in (section.origin, section.target, section.up)
        )
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


def explain_blindness(cameras: Sequence[Camera], grid: Grid, seeing: Sequence[Camera] = ()) -> str:
    """Why, most likely, none of `cameras` sees the box of `grid`.

    `seeing` are those of the scene that do, which they may by chance.
    """
    middle = grid.center_xyz
    if all(_looks_at(camera, grid) for camera in cameras):
        return (
            "it is in the picture, but smaller than a pixel: are volume.bounds and the cameras in"
            " the same unit?"
        )
    for group in ([*cameras, *seeing], cameras):
        for what, convert in CONVENTIONS.items() if len(group) > 1 else ():
            if all(_looks_at(replace(one, pose=convert(one.pose)), grid) for one in group):
                return f"it would with matrices read otherwise; they seem to be {what}"
    if len(cameras) > 1 and (place := _meeting_place(cameras)) is not None:
        return (
            f"the cameras look at about ({', '.join(f'{x:.3g}' for x in place.tolist())}), but the"
            f" middle of volume.bounds is ({', '.join(f'{x:.3g}' for x in middle)}): are both in"
            " the same units and axes?"
        )
    (low, high), pose = grid.bounds_xyz, cameras[0].pose.double()
    center = pose.new_tensor(middle)
    if torch.dot(center - pose[:, 3], -pose[:, 2]) < 0:
        return (
            "the volume lies behind the camera, which looks along its -z axis with +y up, as in"
            " OpenGL: where poses are in OpenCV's axes, negate the second and third column of each"
            " matrix"
        )
    away = torch.dist(center, pose[:, 3]) / torch.dist(pose.new_tensor(low), pose.new_tensor(high))
    return (
        f"the camera looks past it, from {away:.3g} diagonals of the box away: check volume.bounds"
        " (are they in the units of the cameras?), its target, and its field of view or width"
    )


def _inverse(pose: Tensor) -> Tensor:
    turned = pose[:, :3].T
    return torch.cat([turned, -turned @ pose[:, 3:]], 1)


def _looks_at(camera: Camera, grid: Grid) -> bool:
    """Whether the middle of the box of `grid` is in the image of `camera`."""
    center = camera.pose.new_tensor([grid.center_xyz])
    (column, row), _ = (values[0] for values in project(camera, center))
    height, width = camera.size
    return bool((column >= 0) & (column <= width) & (row >= 0) & (row <= height))


def _meeting_place(cameras: Sequence[Camera]) -> Tensor | None:
    """The point (x, y, z) nearest to the axes of `cameras`; None where they are parallel."""
    poses = torch.stack([camera.pose.double() for camera in cameras])
    axes, origins = poses[:, :, 2:3], poses[:, :, 3:]
    across = torch.eye(3, dtype=poses.dtype) - axes @ axes.mT
    total = across.sum(0)
    if torch.linalg.eigvalsh(total)[0] < 1e-3 * len(cameras):
        return None
    return torch.linalg.solve(total, (across @ origins).sum(0))[:, 0]
