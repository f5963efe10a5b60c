"""Cameras of COLMAP's sparse models as the views they stand for.

A model is a folder with `cameras.txt` and `images.txt`, or the same as `.bin`. Its poses are world
to camera with OpenCV's axes (right, down, forward); its points are of no use here and are skipped.
Source: https://colmap.github.io/format.html
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from ddrecon.errors import FormatError
from ddrecon.io.files.reading import guard_reading
from ddrecon.scene_file.nodes import Node
from ddrecon.scene_file.schema import (
    FisheyeSection,
    LensSection,
    Matrix,
    OpencvSection,
    PerspectiveSection,
    ViewSection,
)

MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
"""The camera models that are read, in the order of their numbers in binary files, with their
parameters in order.
"""
MOST_VIEWS, LARGEST_SIDE = 10**5, 16384


class Posed(NamedTuple):
    """An image of a model: its `name`, its camera's number, and the rotation and shift to it."""

    name: str
    camera: int
    pose: Sequence[float]


def read_colmap(node: Node, folder: Path, images: Path) -> list[ViewSection]:
    """The views of the model in `folder`, which `node` of a scene names, in order of their images.

    Their pictures are in the folder `images`; they have no names yet. Raises SceneError where there
    is no model, FormatError for one that is damaged or distorted in a way that is not known.
    """
    suffix = next((end for end in ("txt", "bin") if (folder / f"images.{end}").is_file()), None)
    if suffix is None or not (folder / f"cameras.{suffix}").is_file():
        raise node.refused(
            f"{folder} has no COLMAP model; expected cameras.txt and images.txt, or .bin"
        )
    with guard_reading(folder / f"cameras.{suffix}"):
        cameras = dict(READERS[suffix][0](folder / f"cameras.{suffix}"))
    path = folder / f"images.{suffix}"
    with guard_reading(path):
        posed = sorted(READERS[suffix][1](path), key=lambda image: image.name)
    if not posed:
        raise FormatError(path, "has no images")
    views = []
    for image in posed:
        if image.camera not in cameras:
            raise FormatError(path, f"image {image.name!r}: there is no camera {image.camera}")
        picture = Path(image.name)
        if picture.is_absolute() or ".." in picture.parts:
            raise FormatError(
                path, f"image {image.name!r} leaves the folder of pictures; rename it"
            )
        camera = replace(cameras[image.camera], matrix=_matrix(path, image))
        views.append(ViewSection(camera=camera, image=images / picture))
    return views


def _matrix(path: Path, image: Posed) -> Matrix:
    """Camera to world with OpenGL axes."""
    import numpy as np

    quaternion, shift = np.array(image.pose[:4]), np.array(image.pose[4:])
    norm = math.sqrt(float(quaternion @ quaternion))
    if not (math.isfinite(norm) and norm > 0 and np.isfinite(shift).all()):
        raise FormatError(path, f"image {image.name!r}: its pose is not finite, or no rotation")
    w, x, y, z = quaternion / norm
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    to_world = np.eye(3) - 2 * w * cross + 2 * cross @ cross
    pose = np.eye(4)
    pose[:3, :3] = to_world * (1, -1, -1)
    pose[:3, 3] = -to_world @ shift
    return tuple(map(tuple, pose.tolist()))  # type: ignore[return-value]


def _camera(
    path: Path, number: int, model: str, size: tuple[int, int], parameters: Sequence[float]
) -> PerspectiveSection:
    """Camera `number`, whose pose is still to come."""
    where = f"camera {number}"
    if model not in MODELS:
        raise FormatError(
            path,
            f"{where}: lens model {model} is not known; undistort the pictures"
            " (COLMAP: image_undistorter) and give the model that this makes",
        )
    names, (width, height) = MODELS[model], size
    if len(parameters) != len(names):
        raise FormatError(path, f"{where}: {model} has {len(names)} parameters, {', '.join(names)}")
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        raise FormatError(path, f"{where}: {width} x {height} is no size of an image")
    given = dict(zip(names, parameters, strict=True))
    focal_x = given.get("fx", given.get("f", 0.0))
    focal_y = given.get("fy", focal_x)
    if not (all(map(math.isfinite, parameters)) and focal_x > 0 and focal_y > 0):
        raise FormatError(path, f"{where}: its focal lengths must be above 0, all finite")
    return PerspectiveSection(
        matrix=None,
        resolution=size,
        fov=2 * math.degrees(math.atan(width / 2 / focal_x)),
        principal_point=(given["cx"] / width, given["cy"] / height),
        pixel_aspect=focal_x / focal_y,
        distortion=_lens(model, given),
    )


def _lens(model: str, given: dict[str, float]) -> LensSection | None:
    terms: dict[str, Any] = {
        name: value for name, value in given.items() if name[0] in "kp" and value != 0
    }
    if model == "OPENCV_FISHEYE":
        return FisheyeSection(**terms)
    return OpencvSection(**terms) if terms else None


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file that are no comments, with their numbers."""
    with path.open(encoding="utf-8") as stream:
        for number, line in enumerate(stream, 1):
            if not line.startswith("#"):
                yield number, line.strip()


def _text_cameras(path: Path) -> Iterator[tuple[int, PerspectiveSection]]:
    for number, line in _lines(path):
        if not line:
            continue
        try:
            camera, model, width, height, *parameters = line.split()
            size, values = (int(width), int(height)), [float(word) for word in parameters]
            index = int(camera)
        except ValueError as error:
            raise FormatError(
                path, f"line {number}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found {line!r}"
            ) from error
        yield index, _camera(path, index, model, size, values)


def _text_images(path: Path) -> Iterator[Posed]:
    """Every other line is an image; the others, which may be empty, are its points."""
    lines = _lines(path)
    for number, line in lines:
        if not line:
            continue
        try:
            _, *numbers = (words := line.split(maxsplit=9))[:8]
            pose, camera, name = [float(word) for word in numbers], int(words[8]), words[9]
        except (ValueError, IndexError) as error:
            raise FormatError(
                path,
                f"line {number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME",
            ) from error
        yield Posed(name, camera, pose)
        next(lines, None)


def _binary_cameras(path: Path) -> Iterator[tuple[int, PerspectiveSection]]:
    with path.open("rb") as stream:
        for _ in range(_count(path, stream)):
            number, model, width, height = _unpack(path, stream, "<iiQQ")
            name = dict(enumerate(MODELS)).get(model, f"number {model}")
            parameters = _unpack(path, stream, f"<{len(MODELS.get(name, ()))}d")
            yield number, _camera(path, number, name, (width, height), parameters)


def _binary_images(path: Path) -> Iterator[Posed]:
    with path.open("rb") as stream:
        for _ in range(_count(path, stream)):
            _, *pose, camera = _unpack(path, stream, "<i7di")
            name = bytearray()
            while (letter := _unpack(path, stream, "c")[0]) != b"\0":
                name += letter
            (points,) = _unpack(path, stream, "<Q")
            stream.seek(24 * points, 1)
            yield Posed(name.decode(), camera, pose)


def _count(path: Path, stream: BinaryIO) -> int:
    (count,) = _unpack(path, stream, "<Q")
    if count > MOST_VIEWS:
        raise FormatError(path, f"claims {count} entries; it is damaged, or no COLMAP model")
    return int(count)


def _unpack(path: Path, stream: BinaryIO, layout: str) -> tuple[Any, ...]:
    data = stream.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise FormatError(path, "ends too soon")
    return struct.unpack(layout, data)


READERS = {"txt": (_text_cameras, _text_images), "bin": (_binary_cameras, _binary_images)}
"""What reads cameras and images, by the suffix of their files."""
