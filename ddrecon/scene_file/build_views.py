"""The views section as cameras and pictures, frame by frame, and the box that fits them."""

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.cameras import (
    CELL,
    Camera,
    cast_rays,
    distort,
    edge_places,
    image_places,
    look_at,
    pixel_width,
    project,
    ray_through,
)
from ddrecon.errors import DataWarning, FormatError, Problems
from ddrecon.grid import Grid
from ddrecon.hull import HullError, bound_smoke, find_shown
from ddrecon.io.images.films import FILMS, frame_times, nearest_frame
from ddrecon.io.images.table import Image, read_image, read_mask
from ddrecon.march.samplers import cross_box
from ddrecon.scene import View
from ddrecon.scene_file.load import SceneFile, require
from ddrecon.scene_file.schema import Bounds, SceneTree
from ddrecon.scene_file.view_schema import (
    FRAME,
    CameraSection,
    PerspectiveSection,
    ViewSection,
)
from ddrecon.settings import AUTO, ParameterSettings

READERS: Mapping[str, Callable[[Path, int, float], Image]] = {
    "image": read_image,
    "background": read_image,
    "mask": read_mask,
}
"""What reads the pictures of a view, by their keys."""
SAME_UNIT = "are volume.bounds and the cameras in the same unit?"
CHECKED = 1000
"""Within an image, distortion is checked at so many places; and at all of its edges."""
COARSER = 8
MOST_PIXELS = 2**18
"""Images are made about this small before they are looked at closely."""
MANY_CELLS = 2**22
"""More cells than these take hours."""


@dataclass(frozen=True)
class Maker:
    """Makes tensors of `dtype` on `device` of what `scene_file` says."""

    scene_file: SceneFile
    dtype: torch.dtype = torch.float32
    device: torch.device | str = "cpu"

    @property
    def tree(self) -> SceneTree:
        """The content of the scene file."""
        return self.scene_file.tree

    def tensor(self, value: Any) -> Tensor:
        """`value`, numbers or a tensor."""
        return torch.as_tensor(value, dtype=self.dtype, device=self.device)

    def color(self, name: str, value: Any) -> Tensor:
        """The color `value` of the variable `name`, [1] or [3]; three equal ones are one."""
        return self.tensor(self.tree.share_color(name, value)).view(-1)

    def picture(self, pixels: np.ndarray) -> Tensor:
        """[C, h, w] of `pixels` [h, w, C]."""
        return self.tensor(torch.from_numpy(pixels).permute(2, 0, 1).contiguous())


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

    What their cameras do to radiance stays. Raises SceneError where the size of one is not known
    without.
    """
    views = list[ViewSection]()
    for index, view in enumerate(scene_file.tree.views):
        camera = view.camera
        if size is None and camera.resolution is None:
            fault = "has no resolution but that of its picture; give one by --size W H"
            raise scene_file.refused(f"views.{index}.camera", fault)
        camera = replace(camera, resolution=size or camera.resolution)
        backdrop = None if isinstance(view.background, Path) else view.background
        views.append(replace(view, camera=camera, image=None, mask=None, background=backdrop))
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
    if all(_looks_at(camera, grid) for camera in blind):
        return f"it is in the picture, but smaller than a pixel: {SAME_UNIT}"
    for convention, convert in CONVENTIONS.items() if len(cameras) > 1 else ():
        turned = [replace(camera, pose=convert(camera.pose)) for camera in cameras]
        if all(_looks_at(camera, grid) for camera in turned):
            return f"it would with matrices read otherwise; they seem to be {convention}"
    pose = blind[0].pose.double()
    is_behind = torch.dot(pose.new_tensor(grid.center_xyz) - pose[:, 3], -pose[:, 2]) < 0
    return (
        f"the camera looks {'away from' if is_behind else 'past'} it: check its target, field of"
        " view or width, and that volume.bounds has the units and axes of the cameras, whose"
        " matrices are camera to world with x right, y up and z backward (OpenGL's axes)"
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


def at_frame(scene_file: SceneFile, number: int) -> SceneFile:
    """The scene of the frame `number` of a film."""

    def of_frame(view: ViewSection) -> ViewSection:
        frame = number + view.frame

        def name(path: Path | None) -> Path | None:
            return path and Path(FRAME.sub(lambda field: field[0].format(frame=frame), str(path)))

        return replace(view, image=name(view.image), mask=name(view.mask), frame=frame)

    tree = scene_file.tree
    views = tuple(map(of_frame, tree.views))
    return replace(scene_file, tree=replace(tree, views=views, frames=None))


def each_frame(scene_file: SceneFile) -> list[SceneFile]:
    """The scenes of all frames of a film, or the scene itself."""
    frames = scene_file.tree.frames
    return [at_frame(scene_file, number) for number in frames.numbers] if frames else [scene_file]


def require_frames(scene_file: SceneFile) -> None:
    """Raises SceneError unless all pictures are there, and films have one rate.

    FormatError for films that end before.
    """
    problems, frames = Problems(), each_frame(scene_file)
    for frame in frames:
        is_end = frame is frames[0] or frame is frames[-1]
        for key, view, path in _pictures(frame):
            if not problems.are_many:
                with problems.collecting():
                    require(frame, key, path)
                    if is_end and path.suffix.lower() in FILMS:
                        read_image(path, view.frame, view.time)
    problems.raise_any()
    _require_one_rate(scene_file)


def _pictures(scene_file: SceneFile) -> Iterator[tuple[str, ViewSection, Path]]:
    """The images and masks that the scene names: the key, the view and the path of each."""
    for index, view in enumerate(scene_file.tree.views):
        for key, path in (("image", view.image), ("mask", view.mask)):
            if path is not None:
                yield f"views.{index}.{key}", view, path


def _require_one_rate(scene_file: SceneFile) -> None:
    """Raises SceneError where films that are counted together do not show them together."""
    paces = list[tuple[Path, float, list[float]]]()
    numbers = scene_file.tree.frames.numbers if scene_file.tree.frames else ()
    for key, view, path in _pictures(scene_file):
        if not numbers or path.suffix.lower() not in FILMS:
            continue
        times = frame_times(path)
        first = nearest_frame(times, view.time) + view.frame
        rate = (len(times) - 1) / (times[-1] - times[0] or math.inf)
        begin = times[first] if first >= 0 else times[0] + first / (rate or math.inf)
        paces.append((path, rate, [times[first + number] - begin for number in numbers]))
        film, usual, pace = paces[0]
        apart = max(abs(a - b) for a, b in zip(pace, paces[-1][2], strict=True))
        if apart * usual > 0.5 or (rate and usual and not 0.99 < rate / usual < 1.01):
            fault = (
                f"{path.name} has {rate:.5g} frames a second and {film.name} {usual:.5g}: "
                f"frames of the same number come to be {apart:.2g} s apart; give films of one "
                f"constant rate (ffmpeg -i {path.name} -r {usual:.5g} ...)"
            )
            raise scene_file.refused(key, fault)


def fit_volume(scene_file: SceneFile) -> SceneFile:
    """`scene_file` with its box and resolution in numbers; those of a film fit all of its frames.

    Raises SceneError where the pictures do not tell, and what reading them raises.
    """
    tree = scene_file.tree
    bounds, resolution = tree.volume.bounds, tree.volume.resolution
    if bounds is None:
        fault = "auto takes volume.bounds, a box in numbers or auto as well"
        raise scene_file.refused("volume.resolution", fault)
    if isinstance(bounds, Bounds):
        corners = torch.tensor([bounds.min, bounds.max], dtype=torch.float64)
    else:
        corners = _find_box(scene_file)
    middle, sides = corners.mean(0), corners[1] - corners[0]
    if isinstance(resolution, str):
        views = build_views(Maker(each_frame(scene_file)[0]), None)
        nearest = float(sides.min()) / 2
        cell = CELL * mean(pixel_width(view.camera, middle, nearest) for view in views)
        count = math.prod(math.ceil(side / cell) for side in sides.tolist())
        if count > MANY_CELLS:
            wider = (count / MANY_CELLS) ** (1 / 3)
            fault = (
                f"{count:,} cells two pixels wide take hours: they are {wider:.2g} times as wide"
            )
            warnings.warn(f"volume.resolution: {fault}", DataWarning, 2)
            cell *= wider
        x, y, z = (max(1, math.ceil(side / cell)) for side in sides.tolist())
        resolution = x, y, z
        sides = cell * sides.new_tensor(resolution)
    if isinstance(bounds, Bounds):
        # Other programs take cubes: the box grows upwards, to the right and backward for them.
        grows = [name not in tree.volume.periodic for name in "xyz"]
        ends = (corners[0] + sides).where(torch.tensor(grows), corners[1]).tolist()
        bounds = Bounds(bounds.min, (ends[0], ends[1], ends[2]))
    else:
        digits = 3 - math.floor(math.log10(float(sides.max())))
        low = [round(x, digits) for x in (middle - sides / 2).tolist()]
        # Sides have more digits, or cells would be no cubes.
        high = [round(x + side, digits + 5) for x, side in zip(low, sides.tolist(), strict=True)]
        bounds = Bounds((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    volume = replace(tree.volume, bounds=bounds, resolution=resolution)
    return replace(scene_file, tree=replace(tree, volume=volume))


def _find_box(scene_file: SceneFile) -> Tensor:
    """The corners [2, 3] of the box around all that the pictures may show."""
    parameters = scene_file.tree.optimize.parameters if scene_file.tree.optimize else {}
    density = parameters.get("density", ParameterSettings())

    def frames() -> Iterator[tuple[Sequence[View], Sequence[Tensor]]]:
        for frame in each_frame(scene_file):
            built = build_views(Maker(frame), None)
            views = [view for view in built if view.image is not None and not view.is_test]
            yield views, [find_shown(view, density.support or AUTO) for view in views]

    try:
        return bound_smoke(frames(), density.margin)
    except HullError as error:
        fault = f"auto: {error}; or give min and max in numbers"
        raise scene_file.refused("volume.bounds", fault) from error
