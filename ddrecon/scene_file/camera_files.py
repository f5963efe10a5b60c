"""Camera files of NeRF, instant-ngp and nerfstudio (`transforms.json`), and COLMAP's models.

What a frame says takes precedence over what the file says. Poses are camera to world with OpenGL
axes and stay as they stand: what tells other programs how to map them into a box of their own
(`scale`, `offset`, `aabb_scale`, `applied_transform`) is not for us. Intrinsics are in pixels, or
there is an angle of view.

A COLMAP model is a folder with `cameras.txt` and `images.txt`, or the same as `.bin`. Its poses are
world to camera with OpenCV's axes (right, down, forward); its points are of no use and are skipped.
Source: https://colmap.github.io/format.html
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, BinaryIO

from ddrecon.errors import FormatError, SceneError, gather
from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.folders import require_free_files
from ddrecon.io.files.reading import guard_reading, read_json
from ddrecon.scene_file.read import Node, path_in, read_as
from ddrecon.scene_file.view_schema import (
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
OF_TESTS = re.compile(r"(?<![a-z])(test|val)(?![a-z])", re.IGNORECASE)
OF_TRAINING = re.compile(r"(?<![a-z])train(?![a-z])", re.IGNORECASE)
TEST_LISTS = ("test_filenames", "val_filenames")
OPENCV = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
"""Camera models whose distortion is OpenCV's, as far as they have some."""
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
REMEDY = "undistort the pictures first (COLMAP: image_undistorter) and give the cameras they get"
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2", "k5", "k6")
FOCAL = ("x_fov", "fl_x", "camera_angle_x", "y_fov", "fl_y", "camera_angle_y")
"""What says the focal length. Of an axis, what comes first counts, as in instant-ngp."""
UNKNOWN = (
    *(f"ftheta_p{power}" for power in range(5)),
    *("latlong", "equirectangular", "orthographic"),
    *("sk_x", "sk_y", "skew", "b1", "b2", "s1", "s2", "s3", "s4"),
)
"""What says of a lens that it is not modeled, unless it is 0 or false."""
UNNAMED = ("distortion", "distortion_coefficients", "distortion_params", "dist_coeffs", "dist")
"""Coefficients whose order is not known."""
GROUPS = (
    FOCAL,
    (*COEFFICIENTS, *UNKNOWN, *UNNAMED),
    ("camera_model", "is_fisheye"),
)
"""What belongs together: of a group that a frame has any of, nothing of the file counts."""
NUMBERS: Mapping[str, Mapping[str, float]] = {
    **{f"camera_angle_{axis}": {"above": 0, "below": math.pi} for axis in "xy"},
    **{f"{axis}_fov": {"above": 0, "below": 180} for axis in "xy"},
    **{f"fl_{axis}": {"above": 0} for axis in "xy"},
    **{side: {"minimum": 1, "maximum": 16384} for side in "wh"},
    **{f"c{axis}": {} for axis in "xy"},
}
"""What a camera says of its picture, and within which limits."""
MATRICES = ("K", "intrinsics", "intrinsic_matrix", "camera_intrinsics")
"""What is refused, as it is not read, of a frame that says no focal length besides."""
MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
}
"""The models that are read, in the order of their numbers in binary files, and their parameters."""
UNMODELED = {
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
Posed = tuple[str, int, Sequence[float]]
"""An image of a model: its name, its camera's number, and the rotation and shift to it."""
Entries = Mapping[str, Node]


def read_transforms(
    node: Node, paths: Sequence[Path], test_every: int | None
) -> tuple[ViewSection, ...]:
    """The views in the files `paths`, which `node` of a scene names, still without names.

    A file that does not say which are test views has one in `test_every`. Raises SceneError or
    FormatError.
    """

    def read(path: Path) -> list[ViewSection]:
        if not path.is_file():
            raise node.refused(f"{path} does not exist, or is not a file")
        with guard_reading(path):
            if path.stat().st_size > MAX_BYTES:
                most = f"{MAX_BYTES // 2**20} MiB"
                raise FormatError(path, f"is larger than {most}; it holds more than cameras")
            document = node_of("", str(path), read_json(path))
        with in_file(path):
            return _file_views(document, path, test_every)

    return tuple(chain.from_iterable(gather(read, paths)))


@contextmanager
def in_file(path: Path) -> Iterator[None]:
    """What is wrong with nodes in the block is the fault of the file at `path`."""
    try:
        yield
    except SceneError as error:
        first, *others = error.problems
        raise FormatError(path, first.removeprefix(f"{path}: "), others) from error


def node_of(key: str, where: str, value: Any) -> Node:
    """`value`, as JSON has it, as a node at `key` and all those below it."""
    node = Node(key, where, where, value)
    if isinstance(value, dict):
        node.value = {n: node_of(node.child_key(n), where, entry) for n, entry in value.items()}
    elif isinstance(value, list):
        node.value = [node_of(node.child_key(i), where, entry) for i, entry in enumerate(value)]
    return node


def _file_views(root: Node, path: Path, test_every: int | None) -> list[ViewSection]:
    """Test views are those of the file's lists, or all by its name, or one in `test_every`."""
    if not isinstance(root.value, dict) or "frames" not in root.value:
        raise root.refused(
            "has no 'frames'; expected a transforms.json as of NeRF, instant-ngp or nerfstudio"
        )
    shared, frames, folder = root.value, root.value["frames"], path.absolute().parent
    if not isinstance(frames.value, list) or not frames.value:
        raise frames.refused("expected a list with at least one frame")
    lists = [shared[name] for name in TEST_LISTS if name in shared]
    tests = [read_as(entry, Path, folder) for listed in lists for entry in listed.children()]
    views = gather(lambda frame: _frame_view(frame, shared, folder, tests), frames.value)
    if OF_TESTS.search(path.stem):
        test_every = 1
    elif lists or OF_TRAINING.search(path.stem):
        test_every = None
    return split_views(views, test_every)


def _frame_view(frame: Node, shared: Entries, folder: Path, tests: Collection[Path]) -> ViewSection:
    """The view of a `frame` of a file in `folder`, whose `shared` entries hold for all frames."""
    from ddrecon.io.images.films import FILMS
    from ddrecon.io.images.table import READERS  # here, as it loads numpy

    entries = frame.entries()

    def read(name: str, hint: Any, default: Any = None) -> Any:
        return read_as(entries[name], hint, folder) if name in entries else default

    image, mask = read("file_path", Path), read("mask_path", Path)
    split = "test" if image in tests else "train"
    if (matrices := entries.keys() & set(MATRICES)) and entries.keys().isdisjoint(FOCAL):
        raise entries[min(matrices)].refused("is not read: write fl_x, fl_y, cx, cy, w and h")
    camera = read_camera(frame, _override(shared, entries), folder)
    if image is None and camera.resolution is None:
        raise frame.refused(
            "has neither file_path nor w and h, so that its number of pixels is unknown"
        )
    if image is not None and image.suffix.lower() not in READERS and not image.is_file():
        # What looks like a suffix may be part of a name: images/frame_0.12.
        with_suffix = Path(f"{image}.png")
        if with_suffix.is_file() or not re.fullmatch(r"\.[A-Za-z]\w*", image.suffix):
            image = with_suffix
    # Of pictures, others call a time what lies between 0 and 1.
    is_film = image is not None and image.suffix.lower() in FILMS
    time = read("time", float, 0.0) if is_film else 0.0
    number = read("frame", int, 0)
    return ViewSection(camera=camera, image=image, mask=mask, frame=number, time=time, split=split)


def _override(shared: Entries, entries: Entries) -> Entries:
    """What holds for a frame: its `entries`, and those `shared` ones that they leave alone."""
    replaced = {name for group in GROUPS if entries.keys() & set(group) for name in group}
    if "camera_model" in entries and "PINHOLE" in str(entries["camera_model"].value).upper():
        replaced |= set(GROUPS[1])
    return {name: node for name, node in shared.items() if name not in replaced} | dict(entries)


def read_camera(frame: Node, entries: Entries, folder: Path) -> PerspectiveSection:
    """The camera by `entries`, of `frame` and its file; raises SceneError for what is wrong."""
    if "transform_matrix" not in entries:
        raise frame.refused("missing key 'transform_matrix'")
    matrix = read_as(entries["transform_matrix"], Matrix, folder)
    lens = _intrinsics(frame, entries) | {"distortion": _distortion(entries)}
    camera = PerspectiveSection(matrix=matrix, **lens)
    for _, fault in camera.violations():
        raise entries["transform_matrix"].refused(fault)
    return camera


def _intrinsics(frame: Node, entries: Entries) -> dict[str, Any]:
    """`fov`; with the image's size `resolution`, `principal_point` and `pixel_aspect` as well."""
    numbers: dict[str, float] = {
        name: read_as(entries[name], float, Path(), **limits)
        for name, limits in NUMBERS.items()
        if name in entries
    }
    if numbers.keys().isdisjoint(FOCAL):
        raise frame.refused("has neither fl_x nor camera_angle_x")
    if not {"w", "h"} <= numbers.keys():
        for name in ("fl_x", "fl_y", "cx", "cy"):
            if name in numbers:
                fault = "is in pixels, but w and h do not say how many there are"
                raise entries[name].refused(fault)
        if "x_fov" not in numbers and "camera_angle_x" not in numbers:
            raise frame.refused("says how high its picture is, but not how wide: give w and h")
        return {"fov": numbers.get("x_fov") or math.degrees(numbers["camera_angle_x"])}
    width, height = numbers["w"], numbers["h"]
    for name in ("w", "h"):
        if not numbers[name].is_integer():
            raise entries[name].refused(f"expected a whole number, found {numbers[name]:g}")
    focal_x, focal_y = _focal(numbers, "x", width), _focal(numbers, "y", height)
    focal_x, focal_y = focal_x or focal_y, focal_y or focal_x
    return {
        "fov": 2 * math.degrees(math.atan(width / 2 / focal_x)),
        "resolution": (int(width), int(height)),
        "principal_point": (
            numbers.get("cx", width / 2) / width,
            numbers.get("cy", height / 2) / height,
        ),
        "pixel_aspect": focal_x / focal_y,
    }


def _focal(numbers: Mapping[str, float], axis: str, pixels: float) -> float:
    """The focal length along `axis` of so many `pixels`; 0 where nothing says it."""
    if f"{axis}_fov" in numbers:
        return pixels / 2 / math.tan(math.radians(numbers[f"{axis}_fov"]) / 2)
    if f"fl_{axis}" in numbers or f"camera_angle_{axis}" not in numbers:
        return numbers.get(f"fl_{axis}", 0.0)
    return pixels / 2 / math.tan(numbers[f"camera_angle_{axis}"] / 2)


def _distortion(entries: Entries) -> LensSection | None:
    """The lens; None for a pinhole. Raises SceneError for a model that is not known."""
    model = ""
    if "camera_model" in entries:
        model = read_as(entries["camera_model"], str).upper()
        if model not in (*OPENCV, *FISHEYE):
            fault = f"{entries['camera_model'].value} is a lens that is not modeled; {REMEDY}"
            raise entries["camera_model"].refused(fault)
    for name in (name for name in (*UNKNOWN, *UNNAMED) if name in entries):
        if any(leaf.value for leaf in entries[name].walk() if not leaf.children()):
            fault = f"is of a lens that is not modeled; {REMEDY}"
            raise entries[name].refused(
                fault if name in UNKNOWN else "is not read: write k1, k2, ..."
            )
    is_fisheye = model in FISHEYE
    if "is_fisheye" in entries:
        is_fisheye |= bool(read_as(entries["is_fisheye"], bool | int))
    section = FisheyeSection if is_fisheye else OpencvSection
    lens = {name: read_as(entries[name], float) for name in COEFFICIENTS if name in entries}
    for name in set(lens) - set(LENSES[section.type]):
        if (value := lens.pop(name)) != 0:
            raise entries[name].refused(f"{name} = {value:g} is not modeled; {REMEDY}")
    return section(**lens) if is_fisheye or any(lens.values()) else None


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
        camera = _colmap_camera(of_cameras, number, *cameras[number])
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


def _colmap_camera(
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
    lengths = {name: len(words.split()) for name, words in MODELS.items()} | UNMODELED
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


def in_order(name: str, number: str = "[0-9]+") -> tuple[list[float | str], str]:
    """A key that sorts names by each `number` in them, a regular expression: 2 before 10."""
    words = re.split(f"({number})", name)
    return [float(word) if index % 2 else word for index, word in enumerate(words)], name


def export_transforms(
    scene: Scene, scene_file: SceneFile, path: Path, *, may_exist: bool
) -> list[Path]:
    """Writes the views of `scene`, read from `scene_file`, to `path`, and returns what was written.

    Images and masks are named relative to it; a view without an image has no `file_path`. Raises
    UsageError where `path` exists and may not or its folder is missing, SceneError for views in
    parallel projection.
    """
    require_free_files([path], may_exist=may_exist)
    frames, tests, folder = list[dict[str, Any]](), list[str](), path.absolute().parent
    for view, section in zip(scene.views, scene_file.tree.views, strict=True):
        frame: dict[str, Any] = {"frame": section.frame, "time": section.time}
        for key, file in (("file_path", section.image), ("mask_path", section.mask)):
            if file is not None:
                frame[key] = Path(os.path.relpath(file, folder)).as_posix()
        frames.append(frame | _describe_camera(view))
        tests += [frame["file_path"]] if view.is_test and "file_path" in frame else []
    lists = {TEST_LISTS[0]: tests} if tests else {}
    write_json(path, lists | {"frames": frames})
    return [path]


def _describe_camera(view: View) -> dict[str, Any]:
    camera, model, lens = view.camera, "PINHOLE", dict[str, float]()
    if not camera.is_perspective:
        fault = "an orthographic camera has no place in a transforms.json"
        raise SceneError(f"view {view.name!r}: {fault}")
    if camera.lens is not None and camera.distortion is not None:
        model = {"opencv": "OPENCV", "fisheye": "OPENCV_FISHEYE"}[camera.lens]
        lens = dict(zip(LENSES[camera.lens], camera.distortion.tolist(), strict=True))
    (height, width), (x, y) = camera.size, camera.principal_point
    focal = width / 2 / float(camera.half_width)
    focals = {"fl_x": focal, "fl_y": focal / camera.pixel_aspect}
    pixels = {"w": width, "h": height, "cx": float(x) * width, "cy": float(y) * height}
    pose = [*camera.pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
    return {"camera_model": model, **pixels, **focals, **lens, "transform_matrix": pose}
