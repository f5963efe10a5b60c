"""The scene as a reconstruction leaves it: a scene file to render, relight, trace or export."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ddrecon.errors import UsageError
from ddrecon.scene_file.load import SceneFile, describe
from ddrecon.settings import LENSES
from ddrecon.variables.kinds import PAIRS, PHASE, RESPONSE, split_name

if TYPE_CHECKING:
    from torch import Tensor

    from ddrecon.scene import Scene

RESULT = "result.yaml"
"""The name of the file in a run's folder."""


def require_no_film(folder: Path, more: str = "") -> None:
    """Raises UsageError where `folder` is that of a film, not of a run; it says `more` to do."""
    from ddrecon.io.files.folders import FILM, kind_of_folder

    frames = sorted(folder.glob(f"frames/*/{RESULT}"))
    if frames and kind_of_folder(folder) == FILM:
        text = f"is the folder of a film; name that of a frame, such as {frames[0].parent}"
        raise UsageError(f"{folder}: {text}{more}")


def result_names(parameters: list[str]) -> list[str]:
    """The variables that a result holds: `parameters`, and what is left of a pair of them."""
    partners = [
        medium + name
        for medium, last in map(split_name, parameters)
        for pair in PAIRS
        if last in pair
        for name in pair
    ]
    return list(dict.fromkeys([*parameters, *partners]))


def describe_result(
    scene_file: SceneFile, scene: Scene, values: Mapping[str, Any]
) -> dict[str, Any]:
    """The resolved scene of `scene_file` in plain values, with the reconstructed `values` put in.

    `values` are by variable; a field is `{file: ...}`, a map the name of its file. `scene` is the
    same as tensors, its cameras as reconstructed. Nothing is left to optimize.
    """
    described = {key: value for key, value in describe(scene_file).items() if key != "optimize"}
    # A scene file that leaves out rounds and samples would choose them anew, by its own density.
    for key in ("transport_rounds", "degree", "refine", "refine_along", "halve_along", "receive"):
        if (value := getattr(scene.diffusion, key)) is not None:
            described["diffusion"][key] = value
    described["render"]["steps_per_voxel"] = scene.render.steps
    # The cameras: poses in place of twists.
    for view, section in zip(scene.views, described["views"], strict=True):
        height, width = view.camera.size
        section["camera"]["resolution"] = [width, height]
    put_values(described, {**values, **poses_of(scene, values)})
    return described


def poses_of(scene: Scene, names: Iterable[str]) -> dict[str, Any]:
    """The poses of those cameras of `scene` whose twists are among the variables `names`."""
    poses = {f"views.{view.name}.camera": view.camera.pose for view in scene.views}
    return {
        name: {"matrix": [*poses[name].tolist(), [0.0, 0.0, 0.0, 1.0]]}
        for name in names
        if name in poses
    }


def plain(value: Tensor) -> Any:
    """The number, or list of numbers, that a scene file has for `value`."""
    return value.item() if value.numel() == 1 else value.tolist()


def put_values(described: dict[str, Any], values: Mapping[str, Any]) -> None:
    """Puts `values`, by variable, into the scene `described` in plain values.

    A field is `{file: ...}`, a map the name of its file, a camera `{matrix: ...}`.
    """
    views = {view["name"]: view for view in described["views"]}
    for name, value in values.items():
        owner, _, key = name.rpartition(".")
        place, _, rest = owner.partition(".")
        if place == "views":
            _put_view(views[rest], key, value)
        elif place == "lights":
            described["lights"][int(rest)]["file" if isinstance(value, str) else key] = value
        elif place == "ground":
            described["ground"][key] = {"file": value} if isinstance(value, str) else value
        else:
            medium, key = split_name(name)
            section = described["volume"]
            if medium:
                section = section["media"][medium.split(".")[1]]
            _put_medium(section, key, value)


def _put_view(section: dict[str, Any], key: str, value: Any) -> None:
    camera = section["camera"]
    if key == "camera":
        for other in ("origin", "target", "up"):
            camera.pop(other, None)
        camera |= value
    elif key == "focal":
        camera["fov"] = 2 * math.degrees(math.atan(0.5 / value))
    elif key == "distortion":
        names = LENSES[camera["distortion"]["type"]]
        camera["distortion"] |= dict(zip(names, value, strict=True))
    else:
        (section if key in RESPONSE else camera)[key] = value


def _put_medium(section: dict[str, Any], key: str, value: Any) -> None:
    pairs = {name: pair for pair in PAIRS for name in pair}
    if key in pairs:  # which replaces the other pair
        for other in pairs.keys() - pairs[key]:
            section.pop(other, None)
    if key == "g" or key.startswith(PHASE):
        section = section.get("phase", section)
    section[key.removeprefix(PHASE)] = value
