"""Rings of cameras: where they stand, and which images are theirs."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from example_scene import changed

from ddrecon.scene_file.load import SceneFile, describe, dump_scene, read_scene
from ddrecon.scene_file.schema import PerspectiveSection, RingSection
from ddrecon.scene_file.view_sources import ring_cameras

RING = {"count": 3, "radius": 3.2, "height": 0.3, "fov": 28, "resolution": [8, 6]}
Read = Callable[..., SceneFile]


def test_a_ring_goes_around_its_target_from_z_towards_x() -> None:
    cameras = ring_cameras(RingSection(count=10, radius=2, fov=30, target=(1, 2, 3), height=0.5))
    first, second, *_, last = (camera.origin for camera in cameras)
    assert first == pytest.approx((1, 2.5, 5)) and second[0] > 1 > last[0]
    for camera in cameras:
        x, y, z = camera.origin
        assert y == 2.5 and math.hypot(x - 1, z - 3) == pytest.approx(2)
        same = {"origin": camera.origin, "target": (1, 2, 3), "up": (0, 1, 0), "fov": 30}
        assert camera == PerspectiveSection(**same)
    origins = [camera.origin for camera in cameras]
    turns = [math.dist(origins[i - 1], origins[i]) for i in range(10)]
    assert turns == pytest.approx([4 * math.sin(math.pi / 10)] * 10)


def test_ring_views_have_names_and_no_images(read: Read, tmp_path: Path) -> None:
    scene_file = read(changed(views={"ring": RING, "test_every": 2}))
    views = scene_file.tree.views
    assert [view.name for view in views] == ["ring_00", "ring_01", "ring_02"]
    assert [view.split for view in views] == ["test", "train", "test"]
    assert all(view.image is None for view in views)
    dump_scene(describe(scene_file), tmp_path / "dump.yaml")
    assert read_scene(tmp_path / "dump.yaml").tree == scene_file.tree


@pytest.mark.parametrize(
    "names", [["a", "b", "c"], ["2", "10", "11"], ["09", "10", "100"], ["1_10", "2_1", "2_9"]]
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
