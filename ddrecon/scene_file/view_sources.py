"""Views that a scene does not list one by one, and the names of all.

A COLMAP model is a folder with `cameras.txt` and `images.txt`, or the same as `.bin`. Its poses are
world to camera with OpenCV's axes (right, down, forward); its points are of no use and are skipped.
Source: https://colmap.github.io/format.html
"""

from __future__ import annotations

import glob
import math
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from ddrecon.errors import FormatError, Problems
from ddrecon.grid import Triple
from ddrecon.io.files.reading import guard_reading
from ddrecon.scene_file.nodes import Node
from ddrecon.scene_file.read import path_in
from ddrecon.scene_file.transforms import REMEDY, in_file, node_of, read_camera, read_transforms
from ddrecon.scene_file.view_schema import (
    FRAME,
    PerspectiveSection,
    RingSection,
    ViewSection,
    ViewSource,
    split_views,
)

MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
}
"""The models that are read, in the order of their numbers in binary files, and their parameters."""
OTHERS = {
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}
"""Models of which no image may be, and how many parameters they have."""
Lens = tuple[str, tuple[int, int], Sequence[float]]
"""A camera of a model: what it is called, its width and height, and its parameters."""
DECIMAL = r"(?:(?<=_)-)?[0-9]+(?:\.[0-9]+)?"
"""A number in a name, if it may have a sign and a fraction."""
Posed = tuple[str, int, Sequence[float]]
"""An image of a model: its name, its camera's number, and the rotation and shift to it."""


def views_of(
    node: Node, source: ViewSource | tuple[ViewSection, ...], folder: Path, up: Triple
) -> tuple[ViewSection, ...]:
    """The named views that `source` lists or stands for, which `node` of a scene in `folder` says.

    `up` points up in the scene.
    """
    if isinstance(source, tuple):
        return name_listed(node, source)
    entries, every = node.entries(), source.test_every
    if "images" in entries:
        folder = entries["images"].folder or folder
    if source.transforms is not None:
        files = source.transforms if isinstance(source.transforms, tuple) else (source.transforms,)
        return name_by_images(read_transforms(entries["transforms"], files, every))
    if source.colmap is not None:
        read = read_colmap(entries["colmap"], source.colmap, path_in(folder, source.images or ""))
        return name_by_images(split_views(read, every))
    assert source.ring is not None
    cameras = ring_cameras(source.ring, up)
    images: list[Path] | list[None] = [None] * len(cameras)
    if source.images is not None:
        # Wildcards stand in the last two parts: those above may match without end.
        patterns = [source.images, source.images.replace("\\", "/")]  # as Windows writes it
        is_endless = glob.has_magic(str(Path(patterns[1]).parent.parent))
        names = [[]] if is_endless else [glob.glob(text, root_dir=folder) for text in patterns]
        there = sorted(next(filter(None, names), []), key=in_order)
        if there != sorted(there, key=lambda name: in_order(name, DECIMAL)):
            what = "matches names with fractions or signs, whose order is not plain: count them"
            raise entries["images"].refused(f"{source.images!r} {what} 0, 1, 2, ...")
        images = [path for name in there if (path := (folder / name).absolute()).is_file()]
        if len(images) != len(cameras):
            what = f"{source.images!r} matches {len(images)} files, but the ring has"
            raise entries["images"].refused(f"{what} {len(cameras)} cameras")
    views = [
        ViewSection(name=f"ring_{index:02d}", camera=camera, image=image)
        for index, (camera, image) in enumerate(zip(cameras, images, strict=True))
    ]
    return tuple(split_views(views, every))


def in_order(name: str, number: str = "[0-9]+") -> tuple[list[float | str], str]:
    """A key that sorts names by each `number` in them, a regular expression: 2 before 10."""
    words = re.split(f"({number})", name)
    return [float(word) if index % 2 else word for index, word in enumerate(words)], name


def name_listed(node: Node, views: Sequence[ViewSection]) -> tuple[ViewSection, ...]:
    """The `views` of `node`, nameless ones called by their place; SceneError for equal names."""
    problems, first = Problems(), dict[str, int]()
    names = [view.name or f"view_{index:02d}" for index, view in enumerate(views)]
    for index, name in enumerate(names):
        if first.setdefault(name, index) != index:
            child = node.children()[index]
            what = f"{name!r} is already the name of view {first[name]}"
            problems.note(child.entries().get("name", child).refused(what))
    problems.raise_any()
    return tuple(replace(view, name=name) for view, name in zip(views, names, strict=True))


def name_by_images(views: Sequence[ViewSection]) -> tuple[ViewSection, ...]:
    """`views` with names, all different, by their images where they have some."""
    paths = [view.image or Path(f"view_{index:02d}") for index, view in enumerate(views)]
    # A frame's number is no part of a name: the view of frames/{frame:04d}.png is that of a folder.
    unnumbered = [FRAME.sub("", path.stem).strip("._-") or path.parent.name for path in paths]
    # Of long ones the ends, as file names have room for.
    stems, folders = (
        [re.sub(r"[^A-Za-z0-9_-]", "_", word)[-99:] for word in words]
        for words in (unnumbered, [path.parent.name for path in paths])
    )
    longer = [f"{folder}_{stem}" for folder, stem in zip(folders, stems, strict=True)]
    numbered = [f"{index:03d}_{stem}" for index, stem in enumerate(stems)]
    names = next(names for names in (stems, longer, numbered) if len(set(names)) == len(names))
    return tuple(replace(view, name=name) for view, name in zip(views, names, strict=True))


def ring_cameras(ring: RingSection, up: Triple) -> list[PerspectiveSection]:
    """Camera i of n stands at target + height u + r (cos(2 pi i/n) a + sin(2 pi i/n) u x a).

    u is the unit vector along the ring's own `up` or this one, and a the axis after the one
    nearest to it, made perpendicular.
    """
    import numpy as np

    upward = np.array(ring.up or up) / math.hypot(*(ring.up or up))
    ahead = np.eye(3)[(np.abs(upward).argmax() + 1) % 3]
    ahead = ahead - upward * (ahead @ upward)
    ahead /= np.linalg.norm(ahead)
    aside, cameras = np.cross(upward, ahead), []
    for index in range(ring.count):
        turn = 2 * math.pi * index / ring.count
        way = ring.radius * (math.cos(turn) * ahead + math.sin(turn) * aside)
        x, y, z = (np.array(ring.target) + ring.height * upward + way).tolist()
        camera = PerspectiveSection(fov=ring.fov, resolution=ring.resolution)
        cameras.append(replace(camera, origin=(x, y, z), target=ring.target, up=ring.up or up))
    return cameras


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
    path, of_cameras = folder / f"images.{suffix}", folder / f"cameras.{suffix}"
    with guard_reading(of_cameras):
        cameras = dict(READERS[suffix][0](of_cameras))
    with guard_reading(path):
        posed = sorted(READERS[suffix][1](path), key=lambda image: in_order(image[0]))
    if not posed:
        raise FormatError(path, "has no images")
    views = []
    for name, number, pose in posed:
        if number not in cameras:
            raise FormatError(path, f"image {name!r}: there is no camera {number}")
        picture = PurePosixPath(name.replace("\\", "/"))
        if picture.is_absolute() or ".." in picture.parts:
            raise FormatError(path, f"image {name!r} leaves the folder of pictures; rename it")
        camera = _camera(of_cameras, number, *cameras[number])
        frame = camera | {"transform_matrix": _matrix(path, name, pose)}
        with in_file(of_cameras):
            described = node_of(f"camera {number}", str(of_cameras), frame)
            section = read_camera(described, described.entries(), folder)
        views.append(ViewSection(camera=section, image=path_in(images, name)))
    return views


def _matrix(path: Path, name: str, pose: Sequence[float]) -> list[list[float]]:
    """Camera to world with OpenGL axes."""
    import numpy as np

    quaternion, shift = np.array(pose[:4]), np.array(pose[4:])
    norm = math.sqrt(float(quaternion @ quaternion))
    if not (math.isfinite(norm) and norm > 0 and np.isfinite(shift).all()):
        raise FormatError(path, f"image {name!r}: its pose is not finite, or no rotation")
    w, x, y, z = quaternion / norm
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    to_world = np.eye(3) - 2 * w * cross + 2 * cross @ cross
    matrix = np.eye(4)
    matrix[:3, :3] = to_world * (1, -1, -1)
    matrix[:3, 3] = -to_world @ shift
    return matrix.tolist()


def _camera(
    path: Path, number: int, model: str, size: tuple[int, int], parameters: Sequence[float]
) -> dict[str, Any]:
    """Camera `number` in the words of transforms.json."""
    if model not in MODELS:
        raise FormatError(path, f"camera {number}: lens model {model} is not known; {REMEDY}")
    names = MODELS[model].split()
    if len(parameters) != len(names):
        fault = f"{model} has {len(names)} parameters, {', '.join(names)}"
        raise FormatError(path, f"camera {number}: {fault}")
    lens = dict(zip(names, parameters, strict=True))
    if "f" in lens:
        lens["fl_x"] = lens["fl_y"] = lens.pop("f")
    return {"camera_model": model, "w": size[0], "h": size[1], **lens}


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """The lines of a text file that are neither empty nor comments, with their numbers."""
    with path.open(encoding="utf-8-sig") as stream:
        for number, line in enumerate(map(str.strip, stream), 1):
            if line and not line.startswith("#"):
                yield number, line


def _text_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    for number, line in _lines(path):
        try:
            camera, model, width, height, *parameters = line.split()
            yield int(camera), (model, (int(width), int(height)), [*map(float, parameters)])
        except ValueError as error:
            expected = f"CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found {line!r}"
            raise FormatError(path, f"line {number}: expected {expected}") from error


def _text_images(path: Path) -> Iterator[Posed]:
    for number, line in _lines(path):
        if _are_points(line):  # of the image before, whose line of points may be missing
            continue
        try:
            words = line.split(maxsplit=9)
            yield words[9], int(words[8]), [float(word) for word in words[1:8]]
        except (ValueError, IndexError) as error:
            expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            raise FormatError(path, f"line {number}: expected {expected}") from error


def _are_points(line: str) -> bool:
    """Whether `line` begins with points of an image: X Y POINT3D_ID each."""
    words = line.split(maxsplit=12)[:12]
    try:
        [float(word) for word in words], [int(word) for word in words[2::3]]
    except ValueError:
        return False
    return len(words) % 3 == 0


def _binary_cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    lengths = {name: len(words.split()) for name, words in MODELS.items()} | OTHERS
    with path.open("rb") as stream:
        for _ in range(*_unpack(path, stream, "<Q")):
            number, model, width, height = _unpack(path, stream, "<IiQQ")
            if not 0 <= model < len(lengths):
                raise FormatError(path, f"camera {number}: lens model {model} is not known")
            name = [*lengths][model]
            yield number, (name, (width, height), _unpack(path, stream, f"<{lengths[name]}d"))


def _binary_images(path: Path) -> Iterator[Posed]:
    with path.open("rb") as stream:
        for _ in range(*_unpack(path, stream, "<Q")):
            _, *pose, camera = _unpack(path, stream, "<I7dI")
            name = b"".join(iter(lambda: _unpack(path, stream, "c")[0], b"\0"))
            (points,) = _unpack(path, stream, "<Q")
            if 24 * points > path.stat().st_size - stream.tell():
                raise FormatError(path, "ends too soon")
            stream.seek(24 * points, 1)
            yield name.decode(), camera, pose


def _unpack(path: Path, stream: BinaryIO, layout: str) -> tuple[Any, ...]:
    data = stream.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise FormatError(path, "ends too soon")
    return struct.unpack(layout, data)


READERS = {"txt": (_text_cameras, _text_images), "bin": (_binary_cameras, _binary_images)}
"""What reads cameras and images, by the suffix of their files."""
