"""The scene as a reconstruction has found it: a scene file to render, relight, trace or export."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ddrecon.scene import Scene
from ddrecon.scene_file.dump import describe
from ddrecon.scene_file.load import SceneFile
from ddrecon.variables.kinds import PAIRS, VOLUME

RESULT = "result.yaml"
"""What the file is called in a run's folder."""


def found_names(parameters: list[str]) -> list[str]:
    """The variables that a result holds where `parameters` were optimized: these, and what is left
    of a pair of them.
    """
    partners = [name for pair in PAIRS if set(pair) & set(parameters) for name in pair]
    return list(dict.fromkeys([*parameters, *partners]))


def describe_result(
    scene_file: SceneFile, scene: Scene, found: Mapping[str, Any]
) -> dict[str, Any]:
    """The resolved scene of `scene_file` in plain values, with those `found` put in, by variable;
    nothing is left to optimize.

    `scene` is the same as tensors, its cameras as they were found. A field is `{file: ...}`, a map
    the name of its file.
    """
    described = {key: value for key, value in describe(scene_file).items() if key != "optimize"}
    low, high = scene.volume.grid.bounds_xyz
    known = {name: value for name, value in found.items() if name in VOLUME}
    replaced = {name for pair in PAIRS if set(pair) & set(known) for name in (*PAIRS[0], *PAIRS[1])}
    kept = {name: value for name, value in described["volume"].items() if name not in replaced}
    box = {
        "bounds": {"min": list(low), "max": list(high)},
        "resolution": list(reversed(scene.volume.grid.shape)),
    }
    described["volume"] = kept | box | known
    for name, value in found.items():
        kind, _, rest = name.partition(".")
        if kind == "lights":
            index, _, attribute = rest.partition(".")
            described["lights"][int(index)]["file" if isinstance(value, str) else attribute] = value
    for view, section in zip(scene.views, described["views"], strict=True):
        is_found = f"views.{view.name}.camera" in found
        section["camera"] = _move_file(
            section["camera"], view.camera.pose.tolist() if is_found else None, view.camera.size
        )
    return described


def _move_file(
    camera: dict[str, Any], pose: list[list[float]] | None, size: tuple[int, int]
) -> dict[str, Any]:
    """The section `camera` with its pixels said, and standing where `pose` [3, 4] says if that is
    given.
    """
    sized = camera | {"resolution": [size[1], size[0]]}
    if pose is None:
        return sized
    return {key: value for key, value in sized.items() if key not in ("origin", "target", "up")} | {
        "matrix": [*pose, [0, 0, 0, 1]]
    }
