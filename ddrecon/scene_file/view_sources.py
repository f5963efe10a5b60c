"""Views that a scene does not list one by one, and the names of all."""

from __future__ import annotations

import glob
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ddrecon.scene_file.colmap import read_colmap
from ddrecon.scene_file.nodes import Node
from ddrecon.scene_file.problems import Problems
from ddrecon.scene_file.schema import (
    PerspectiveSection,
    RingSection,
    ViewSection,
    ViewSource,
    split_views,
)
from ddrecon.scene_file.transforms import read_transforms


def views_of(node: Node, source: ViewSource, folder: Path) -> tuple[ViewSection, ...]:
    """The views that `source` stands for, which `node` of a scene in `folder` says."""
    entries = node.entries()
    every = source.test_every
    if source.transforms is not None:
        paths = source.transforms if isinstance(source.transforms, tuple) else (source.transforms,)
        return name_by_images(read_transforms(entries["transforms"], paths, every))
    if source.colmap is not None:
        pictures = (folder / (source.images or "")).absolute()
        read = read_colmap(entries["colmap"], source.colmap, pictures)
        return name_by_images(split_views(read, every))
    assert source.ring is not None
    cameras = ring_cameras(source.ring)
    images: list[Path] | list[None] = [None] * len(cameras)
    if source.images is not None:
        images = match_files(source.images, folder)
        if len(images) != len(cameras):
            what = f"{source.images!r} matches {len(images)} files, but the ring has"
            raise entries["images"].refused(f"{what} {len(cameras)} cameras")
    views = [
        ViewSection(name=f"ring_{index:02d}", camera=camera, image=image)
        for index, (camera, image) in enumerate(zip(cameras, images, strict=True))
    ]
    return tuple(split_views(views, every))


def name_listed(
    node: Node, views: tuple[ViewSection, ...], folder: Path
) -> tuple[ViewSection, ...]:
    """The `views` listed in `node`, those without a name called by their place.

    Raises SceneError where two have the same.
    """
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
    stems = [_in_names(path.stem) for path in paths]
    folders = [_in_names(path.parent.name) for path in paths]
    longer = [f"{folder}_{stem}" for folder, stem in zip(folders, stems, strict=True)]
    numbered = [f"{index:03d}_{stem}" for index, stem in enumerate(stems)]
    names = next(names for names in (stems, longer, numbered) if len(set(names)) == len(names))
    return tuple(replace(view, name=name) for view, name in zip(views, names, strict=True))


def _in_names(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", text)


def ring_cameras(ring: RingSection) -> list[PerspectiveSection]:
    """Camera i of n stands at target + (r sin(2 pi i/n), height, r cos(2 pi i/n))."""
    (x, y, z), cameras = ring.target, []
    for index in range(ring.count):
        turn = 2 * math.pi * index / ring.count
        right, forth = ring.radius * math.sin(turn), ring.radius * math.cos(turn)
        origin = x + right, y + ring.height, z + forth
        camera = PerspectiveSection(fov=ring.fov, resolution=ring.resolution)
        cameras.append(replace(camera, origin=origin, target=ring.target, up=ring.up))
    return cameras


def match_files(pattern: str, folder: Path) -> list[Path]:
    """The files that match the glob `pattern`, as sorted absolute paths.

    It is relative to `folder`; wildcards stand in its last two parts.
    """
    if glob.has_magic(str(Path(pattern).parent.parent)):
        return []
    return sorted(
        path
        for name in glob.glob(pattern, root_dir=folder)
        if (path := (folder / name).absolute()).is_file()
    )
