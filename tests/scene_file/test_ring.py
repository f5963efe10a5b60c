"""Rings of cameras: where they stand, and which images are theirs."""

import math
from collections.abc import Callable
from operator import mul, sub
from pathlib import Path
from typing import Any

import pytest
import yaml
from example_scene import SCENE, changed

from ddrecon.scene_file.build import build_scene
from ddrecon.scene_file.load import SceneFile, describe, dump_scene, read_scene
from ddrecon.scene_file.view_schema import PerspectiveSection, RingSection
from ddrecon.scene_file.view_sources import ring_cameras
from ddrecon.turntable import upright_axis

RING = {"count": 3, "radius": 3.2, "height": 0.3, "fov": 28, "resolution": [8, 6]}
Read = Callable[..., SceneFile]


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
    ring = {name: value for name, value in RING.items() if name != "resolution"}
    views = read(changed(views={"ring": ring, "images": pattern})).tree.views
    assert [view.image for view in views] == paths


@pytest.mark.parametrize("names", [["0.25", "0.5", "1"], ["-30", "0", "30"], ["1.9", "1.10", "2"]])
def test_an_order_that_is_not_plain_is_refused(
    refusal: Callable[..., list[str]], tmp_path: Path, names: list[str]
) -> None:
    for name in names:
        (tmp_path / f"t_{name}.exr").touch()
    (line,) = refusal(changed(views={"ring": RING, "images": "t_*.exr"}))
    assert "views.images: 't_*.exr' matches names with fractions or signs" in line
