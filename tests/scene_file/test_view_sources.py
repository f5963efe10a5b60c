"""Views that are not listed: rings of cameras and their images; COLMAP's models."""

import math
import struct
from collections.abc import Callable
from operator import mul, sub
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from example_scene import SCENE, changed

from ddrecon.cameras import cast_rays, project
from ddrecon.errors import FormatError, SceneError
from ddrecon.lenses import distort
from ddrecon.scene_file.build import build_scene
from ddrecon.scene_file.build_views import remove_pictures
from ddrecon.scene_file.load import SceneFile, describe, dump_scene, read_scene
from ddrecon.scene_file.view_schema import PerspectiveSection, RingSection
from ddrecon.scene_file.view_sources import MODELS, OTHERS, ring_cameras
from ddrecon.settings import LENSES
from ddrecon.turntable import upright_axis

Read = Callable[..., SceneFile]
RING = {"count": 3, "radius": 3.2, "height": 0.3, "fov": 28, "resolution": [8, 6]}


@pytest.mark.parametrize("up", range(3))
@pytest.mark.parametrize("is_own", [True, False])
def test_a_ring_goes_around_its_target_about_the_way_up(up: int, is_own: bool) -> None:
    """From the axis after it, x, y, z and x again, towards the one after that."""
    upright, ahead, aside = up, (up + 1) % 3, (up + 2) % 3
    along = (float(up == 0), float(up == 1), float(up == 2))
    given = {"up": along} if is_own else {}
    ring = RingSection(count=10, radius=2, fov=30, target=(1, 2, 3), height=0.5, **given)
    cameras = ring_cameras(ring, (1.0, 2.0, 3.0) if is_own else along)
    offsets = [tuple(map(sub, camera.origin or (), ring.target)) for camera in cameras]
    assert offsets[0][ahead] == 2 and offsets[1][aside] > 0 > offsets[-1][aside]
    for camera, offset in zip(cameras, offsets, strict=True):
        assert offset[upright] == 0.5
        assert math.hypot(offset[ahead], offset[aside]) == pytest.approx(2)
        same = {"origin": camera.origin, "target": (1, 2, 3), "up": along, "fov": 30}
        assert camera == PerspectiveSection(**same)
    turns = [math.dist(offsets[i - 1], offsets[i]) for i in range(10)]
    assert turns == pytest.approx([4 * math.sin(math.pi / 10)] * 10)


def test_a_ring_lies_around_a_tilted_way_up() -> None:
    """Whatever its length: cameras keep their height along it, and their distance."""
    up = (0.3, -2.0, 0.5)
    ring = RingSection(count=5, radius=2, fov=30, height=0.5, up=up)
    for camera in ring_cameras(ring, (0, 1, 0)):
        assert camera.origin is not None
        assert sum(map(mul, camera.origin, up)) == pytest.approx(0.5 * math.hypot(*up))
        assert math.hypot(*camera.origin) == pytest.approx(math.hypot(2, 0.5))


@pytest.mark.parametrize(
    ("volume", "ring", "axis"),
    [({}, {}, 1), ({"up": "z"}, {}, 2), ({"up": "x"}, {}, 0), ({"up": "z"}, {"up": [0, 1, 0]}, 1)],
)
def test_the_volume_says_what_is_up(read: Read, volume: Any, ring: Any, axis: int) -> None:
    volume = yaml.safe_load(SCENE)["volume"] | volume
    scene_file = read(changed(volume=volume, views={"ring": RING | ring}))
    assert upright_axis(build_scene(scene_file)) == "xyz".index(volume.get("up", "y"))
    views = scene_file.tree.views
    assert [view.camera.origin[axis] for view in views] == [RING["height"]] * 3
    assert [view.camera.up[axis] for view in views] == [1] * 3


def test_ring_views_have_names_and_no_images(read: Read, tmp_path: Path) -> None:
    scene_file = read(changed(views={"ring": RING, "test_every": 2}))
    views = scene_file.tree.views
    assert [view.name for view in views] == ["ring_00", "ring_01", "ring_02"]
    assert [view.split for view in views] == ["test", "train", "test"]
    assert all(view.image is None for view in views)
    dump_scene(describe(scene_file), tmp_path / "dump.yaml")
    assert read_scene(tmp_path / "dump.yaml").tree == scene_file.tree


@pytest.mark.parametrize(
    "names",
    [
        *(["a", "b", "c"], ["2", "10", "11"], ["09", "10", "100"], ["1_10", "2_1", "2_9"]),
        *(["0.25", "0.50", "1.00"], ["a-2", "a-9", "a-10"]),
    ],
)
@pytest.mark.parametrize("pattern", ["targets/t_*.exr", "targets\\t_*.exr"])
def test_images_are_in_order_of_their_numbers(
    read: Read, tmp_path: Path, names: list[str], pattern: str
) -> None:
    """Of files alone, which are relative to the scene."""
    (tmp_path / "targets").mkdir()
    paths = [tmp_path / "targets" / f"t_{name}.exr" for name in names]
    for path in reversed(paths):
        path.touch()
    (tmp_path / "targets" / "t_d.exr").mkdir()
    views = read(changed(views={"ring": RING, "images": pattern})).tree.views
    assert [view.image for view in views] == paths


@pytest.mark.parametrize("names", [["0.25", "0.5", "1"], ["-30", "0", "30"], ["1.9", "1.10", "2"]])
def test_an_order_that_is_not_plain_is_refused(
    refusal: Callable[..., list[str]], tmp_path: Path, names: list[str]
) -> None:
    for name in names:
        (tmp_path / f"t_{name}.exr").touch()
    (line,) = refusal(changed(views={"ring": RING, "images": "t_*.exr"}))
    assert "views.images: 't_*.exr' matches names with fractions or signs" in line


# COLMAP: rays as its manual has them, text and binary alike, and refusals in one line.

CAMERAS: dict[str, list[float]] = {
    "SIMPLE_PINHOLE": [20.0, 4.2, 3.1],
    "PINHOLE": [20.0, 19.0, 4.2, 3.1],
    "SIMPLE_RADIAL": [20.0, 4.2, 3.1, -0.2],
    "RADIAL": [20.0, 4.2, 3.1, -0.2, 0.1],
    "OPENCV": [20.0, 19.0, 4.2, 3.1, -0.2, 0.1, 0.01, -0.02],
    "OPENCV_FISHEYE": [20.0, 19.0, 4.2, 3.1, 0.05, -0.02, 0.01, 0.0],
}
QUATERNION = np.array([0.2, 0.9, -0.3, 0.1])
SHIFT = np.array([0.1, -0.2, 3.0])
"""Of a camera that looks at the world's origin from 3 u away, nearly."""


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """By the sandwich q v q*, vector by vector."""
    w, *axis = quaternion / np.linalg.norm(quaternion)
    u = np.array(axis)
    columns = [2 * (u @ v) * u + (w * w - u @ u) * v + 2 * w * np.cross(u, v) for v in np.eye(3)]
    return np.stack(columns, 1)


def write_text(folder: Path, model: str, name: str = "b c.png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    numbers = " ".join(map(str, CAMERAS[model]))
    (folder / "cameras.txt").write_text(f"# cameras\n7 {model} 8 6 {numbers}\n")
    pose = " ".join(map(str, [*QUATERNION, *SHIFT]))
    points = "1.5 2.5 -1 3.5 4.5 12"
    (folder / "images.txt").write_text(
        f"# images\n3 {pose} 7 {name}\n{points}\n4 {pose} 7 a.png\n\n"
    )


def write_binary(
    folder: Path, model: str, name: str = "b c.png", points: tuple[int, int] = (2, 0)
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    numbers = CAMERAS[model]
    header = struct.pack("<QiiQQ", 1, 7, list(MODELS).index(model), 8, 6)
    (folder / "cameras.bin").write_bytes(header + struct.pack(f"<{len(numbers)}d", *numbers))
    content = struct.pack("<Q", 2)
    for index, label, count in ((3, name, points[0]), (4, "a.png", points[1])):
        content += struct.pack("<i7di", index, *QUATERNION, *SHIFT, 7) + label.encode() + b"\0"
        content += struct.pack("<Q", count) + bytes(24 * count)
    (folder / "images.bin").write_bytes(content)


def scene_text(**others: Any) -> str:
    return changed(views={"colmap": "sparse/0", "images": "pictures", **others})


@pytest.mark.parametrize("store", [write_text, write_binary])
@pytest.mark.parametrize("model", CAMERAS)
def test_points_are_seen_where_the_manual_says(
    read: Read, tmp_path: Path, model: str, store: Callable[..., None]
) -> None:
    """x = R X + t, divided by its depth, distorted, and times the focal lengths plus the center."""
    store(tmp_path / "sparse/0", model)
    scene_file = read(scene_text())
    first, second = scene_file.tree.views
    assert (first.name, second.name) == ("a", "b_c")
    assert second.image == tmp_path / "pictures" / "b c.png"
    scene = build_scene(remove_pictures(scene_file, None), dtype=torch.float64)
    camera = scene.views[1].camera
    given = dict(zip(MODELS[model].split(), CAMERAS[model], strict=True))
    lens = "fisheye" if model == "OPENCV_FISHEYE" else "opencv"
    numbers = torch.tensor([given.get(name, 0.0) for name in LENSES[lens]]).double()
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.4, 0.4, (10, 3)))
    rays = points @ torch.from_numpy(rotation(QUATERNION).T) + torch.from_numpy(SHIFT)
    focal = [given.get(name, given.get("f")) for name in ("fl_x", "fl_y")]
    expected = distort(lens, numbers, rays) * torch.tensor(focal) + torch.tensor([4.2, 3.1])
    seen, _ = project(camera, points)
    is_seen = ~seen.isnan().any(1)
    assert is_seen.any()
    torch.testing.assert_close(seen[is_seen], expected[is_seen], atol=1e-5, rtol=0)
    center = -rotation(QUATERNION).T @ SHIFT
    torch.testing.assert_close(cast_rays(camera).eye.flip(0), torch.tensor(center))


def test_one_in_so_many_is_a_test_view(read: Read, tmp_path: Path) -> None:
    write_text(tmp_path / "sparse/0", "PINHOLE")
    views = read(scene_text(test_every=2)).tree.views
    assert [view.split for view in views] == ["test", "train"]


IMAGE = "1 0.2 0.9 -0.3 0.1 0.1 -0.2 3.0 7"
POINTS = "1.5 2.5 -1 3.5 4.5 12"


@pytest.mark.parametrize(
    "lines",
    [
        ["a.png", "b 2.png", "b 10.png"],
        ["b 10.png", "", "a.png", "b 2.png"],
        ["b 2.png", POINTS, "b 10.png", "a.png"],
        ["", "", "a.png", "", "  ", "# c", "b 10.png", POINTS, "", "b 2.png"],
    ],
)
def test_lines_of_points_may_be_missing(read: Read, tmp_path: Path, lines: list[str]) -> None:
    """No image is taken for points; pictures are in order of their numbers."""
    write_text(tmp_path / "sparse/0", "PINHOLE")
    text = [f"{IMAGE} {line}" if line.endswith("png") else line for line in lines]
    (tmp_path / "sparse/0/images.txt").write_text("\n".join(text))
    assert [view.name for view in read(scene_text()).tree.views] == ["a", "b_2", "b_10"]


def test_a_line_that_is_neither_is_refused(read: Read, tmp_path: Path) -> None:
    write_text(tmp_path / "sparse/0", "PINHOLE")
    (tmp_path / "sparse/0/images.txt").write_text(f"{IMAGE} a.png\n{IMAGE}")
    with pytest.raises(FormatError, match="line 2: expected IMAGE_ID"):
        read(scene_text())


def test_models_of_windows_are_read(read: Read, tmp_path: Path) -> None:
    """With a byte order mark, other ends of lines, and backslashes; but not out of the folder."""
    folder = tmp_path / "sparse/0"
    write_text(folder, "PINHOLE", "left\\c.png")
    for path in folder.iterdir():
        path.write_bytes(path.read_text().replace("\n", "\r\n").encode("utf-8-sig"))
    views = read(changed(views={"colmap": "sparse\\0", "images": "pictures"})).tree.views
    assert [view.image for view in views] == [
        tmp_path / "pictures" / name for name in ("a.png", "left/c.png")
    ]
    write_text(folder, "PINHOLE", "left\\..\\..\\c.png")
    with pytest.raises(FormatError, match="leaves the folder of pictures"):
        read(scene_text())


@pytest.mark.parametrize("model", OTHERS)
def test_cameras_that_no_image_has_may_be_of_any_model(
    read: Read, tmp_path: Path, model: str
) -> None:
    """As text, and in a binary file, which says nothing of their length."""
    text, binary, count = tmp_path / "sparse/0", tmp_path / "sparse/1", OTHERS[model]
    write_text(text, "PINHOLE")
    write_binary(binary, "PINHOLE")
    before = read(scene_text()).tree
    with (text / "cameras.txt").open("a") as stream:
        stream.write(f"8 {model} 8 6 {'0.5 ' * count}\n")
    cameras, kind = (binary / "cameras.bin").read_bytes()[8:], [*MODELS, *OTHERS].index(model)
    strange = struct.pack(f"<QiiQQ{count}d", 2, 8, kind, 8, 6, *[0.5] * count)
    (binary / "cameras.bin").write_bytes(strange + cameras)
    assert read(scene_text()).tree == read(scene_text(colmap="sparse/1")).tree == before


@pytest.mark.parametrize(
    ("file", "old", "new", "problem"),
    [
        ("cameras.txt", "PINHOLE", "FOV", "camera 7: lens model FOV is not known; undistort"),
        ("cameras.txt", " 3.1", "", "camera 7: PINHOLE has 4 parameters, fl_x, fl_y, cx, cy"),
        ("cameras.txt", "8 6", "8 x", "line 2: expected CAMERA_ID MODEL WIDTH"),
        ("cameras.txt", "8 6", "8 0", "camera 7.h: must be at least 1, found 0"),
        ("cameras.txt", "20.0", "-20", "camera 7.fl_x: must be above 0"),
        ("cameras.txt", "20.0", "nan", "camera 7.fl_x: expected a finite number"),
        ("images.txt", " 7 b", " 8 b", "image 'b c.png': there is no camera 8"),
        ("images.txt", "b c.png", "/etc/c.png", "image '/etc/c.png' leaves the folder of pictures"),
        ("images.txt", "b c.png", "d/../../c.png", "leaves the folder of pictures"),
        ("images.txt", "3 0.2", "3 x", "line 2: expected IMAGE_ID QW QX"),
        ("images.txt", "0.2 0.9 -0.3 0.1 0.1", "0 0 0 0 0.1", "not finite, or no rotation"),
    ],
)
def test_a_damaged_text_is_refused(
    read: Read, tmp_path: Path, file: str, old: str, new: str, problem: str
) -> None:
    write_text(tmp_path / "sparse/0", "PINHOLE")
    path = tmp_path / "sparse/0" / file
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises((FormatError, SceneError)) as caught:
        read(scene_text())
    assert problem in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_a_damaged_binary_is_refused(read: Read, tmp_path: Path, file: str) -> None:
    """Cut anywhere, in points that are skipped as well, or claiming more than there is."""
    write_binary(tmp_path / "sparse/0", "OPENCV", points=(0, 2))
    path = tmp_path / "sparse/0" / file
    whole = path.read_bytes()
    for damaged in (whole[:5], whole[:30], whole[:-5], b"\xff" * 8 + whole[8:], b""):
        path.write_bytes(damaged)
        with pytest.raises((FormatError, SceneError)) as caught:
            read(scene_text())
        assert "\n" not in str(caught.value)
