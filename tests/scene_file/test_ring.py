"""Rings of cameras: they turn as the reference views do, and pair with images in sorted order."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from example_scene import changed

from ddrecon.scene_file.dump import dump_scene
from ddrecon.scene_file.load import SceneFile, read_scene
from ddrecon.scene_file.schema import PerspectiveSection, RingSection
from ddrecon.scene_file.view_sources import ring_cameras

RING = {"count": 3, "radius": 3.2, "height": 0.3, "fov": 28, "resolution": [8, 6]}
ORIGINS = [  # of the cameras of shared/reference/views_plume, train_00 to train_09
    (0.0, 0.3, 3.2),
    (1.880912807335914, 0.3, 2.588854381999832),
    (3.0433808521444914, 0.3, 0.9888543819998319),
    (3.043380852144492, 0.3, -0.9888543819998316),
    (1.8809128073359145, 0.3, -2.5888543819998318),
    (0.0, 0.3, -3.2),
    (-1.8809128073359138, 0.3, -2.588854381999832),
    (-3.0433808521444914, 0.3, -0.9888543819998322),
    (-3.043380852144492, 0.3, 0.9888543819998312),
    (-1.880912807335914, 0.3, 2.588854381999832),
]

Read = Callable[..., SceneFile]
Refusal = Callable[..., list[str]]


def test_a_ring_is_the_ring_of_the_reference_views():
    cameras = ring_cameras(
        RingSection(count=10, radius=3.2, fov=28, height=0.3, resolution=(128, 128))
    )
    for camera, origin in zip(cameras, ORIGINS, strict=True):
        assert camera.origin == pytest.approx(origin, abs=1e-12)
        assert camera == PerspectiveSection(
            origin=camera.origin, target=(0, 0, 0), up=(0, 1, 0), fov=28, resolution=(128, 128)
        )


def test_a_ring_goes_around_its_target():
    first, second = ring_cameras(RingSection(count=2, radius=2, fov=30, target=(1, 2, 3)))
    assert (
        first.origin == pytest.approx((1, 2, 5))
        and second.origin == pytest.approx((1, 2, 1))
        and first.target == (1, 2, 3)
    )


def test_ring_views_have_names_and_no_images(read: Read, tmp_path: Path):
    scene_file = read(changed(views={"ring": RING}))
    assert [view.name for view in scene_file.tree.views] == ["ring_00", "ring_01", "ring_02"]
    assert all(view.image is None and view.split == "train" for view in scene_file.tree.views)
    dump_scene(scene_file, tmp_path / "dump.yaml")
    assert read_scene(tmp_path / "dump.yaml").tree == scene_file.tree


def test_one_view_in_so_many_is_a_test_view_whatever_the_source(read: Read):
    tree = read(changed(views={"ring": RING, "test_every": 2})).tree
    assert [view.split for view in tree.views] == ["test", "train", "test"]


def test_images_are_sorted_and_relative_to_the_scene(read: Read, tmp_path: Path):
    (tmp_path / "targets").mkdir()
    for name in ("c", "a", "b"):
        (tmp_path / "targets" / f"t_{name}.exr").touch()
    (tmp_path / "targets" / "t_d.exr").mkdir()
    ring = {name: value for name, value in RING.items() if name != "resolution"}
    views = read(changed(views={"ring": ring, "images": "targets/t_*.exr"})).tree.views
    assert [view.image for view in views] == [
        tmp_path / "targets" / f"t_{name}.exr" for name in "abc"
    ]


def test_as_many_images_as_cameras(refusal: Refusal, tmp_path: Path):
    (tmp_path / "a.exr").touch()
    (line,) = refusal(changed(views={"ring": RING, "images": "*.exr"}))
    assert "views.images: '*.exr' matches 1 files, but the ring has 3 cameras" in line


@pytest.mark.parametrize(
    ("views", "problem"),
    [
        ({"ring": RING | {"count": 0}}, "views.ring.count: must be at least 1"),
        ({"ring": RING | {"count": 10**9}}, "views.ring.count: must be at most 10000"),
        ({"ring": RING | {"radius": 0}}, "views.ring.radius: must be above 0"),
        ({"ring": {"count": 3, "radius": 1, "fov": 30}}, "views.ring: missing key 'resolution'"),
        ({"images": "*.exr"}, "views: missing ring or transforms"),
        ({"image": "*.exr", "ring": RING}, "views.image: unknown key; did you mean 'images'?"),
        ("ring", "views: expected a list with at least one entry or a mapping, found 'ring'"),
    ],
)
def test_one_fault_is_one_line(refusal: Refusal, views: object, problem: str):
    (line,) = refusal(changed(views=views))
    assert problem in line
