"""A ring of cameras as the views it stands for."""

from __future__ import annotations

import glob
import math
from pathlib import Path

from ddrecon.scene_file.camera_schema import PerspectiveSection
from ddrecon.scene_file.nodes import Node
from ddrecon.scene_file.schema import RingSection, ViewSection


def ring_cameras(ring: RingSection) -> list[PerspectiveSection]:
    """Camera i of n stands at target + (r sin(2 pi i/n), height, r cos(2 pi i/n))."""
    x, y, z = ring.target
    turns = [2 * math.pi * index / ring.count for index in range(ring.count)]
    origins = [
        (x + ring.radius * math.sin(turn), y + ring.height, z + ring.radius * math.cos(turn))
        for turn in turns
    ]
    return [
        PerspectiveSection(
            origin=origin, target=ring.target, up=ring.up, fov=ring.fov, resolution=ring.resolution
        )
        for origin in origins
    ]


def ring_views(
    node: Node, ring: RingSection, pattern: str | None, folder: Path
) -> tuple[ViewSection, ...]:
    """The views of the section `node`, named ring_00, ...

    Raises SceneError unless `pattern` matches as many images as there are cameras.
    """
    cameras = ring_cameras(ring)
    images: list[Path] | list[None] = [None] * len(cameras)
    if pattern is not None:
        images = match_files(pattern, folder)
        if len(images) != len(cameras):
            entry = node.value["images"] if isinstance(node.value, dict) else node
            raise entry.refused(
                f"{pattern!r} matches {len(images)} files, but the ring has {len(cameras)} cameras"
            )
    return tuple(
        ViewSection(f"ring_{index:02d}", camera, image)
        for index, (camera, image) in enumerate(zip(cameras, images, strict=True))
    )


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
