"""Cameras, exposures and lights, which do not change in a film: found once, and then fixed.

It is found from several frames together; `shared.json` keeps it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ddrecon.errors import FormatError, UsageError
from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.reading import guard_reading
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.run.report import list_numbers
from ddrecon.run.result import plain, poses_of, put_values
from ddrecon.run.run_folder import write_values
from ddrecon.variables.values import EVERY

SHARED = "shared.json"


def write_shared(path: Path, together: Reconstruction, numbers: list[int]) -> None:
    """Writes what the frames `numbers` have found `together` to `path`."""
    scene, values = together.frames[0].current_scene(), dict[str, Any]()
    poses = poses_of(scene, [p.name for p in together.shared])
    for p in together.shared:
        value = p.value.detach()
        if value.ndim >= 3:
            stem, grid = path.with_name(f"shared.{p.name}"), scene.volume.grid
            values[p.name] = {"file": write_values(stem, p.name, value, grid, is_map=True)}
        else:
            values[p.name] = poses.get(p.name) or plain(value)
    start = together.frames[0].problem.scene
    texts = {name: text for name, _, text in list_numbers(together.shared, start, scene)}
    write_json(path, {"frames": numbers, "values": values, "texts": texts})


def read_shared(path: Path) -> dict[str, Any]:
    """What `path`, a `shared.json`, says. Raises UsageError and FormatError."""
    if not path.is_file():
        raise UsageError(f"--shared {path}: there is no such file; a film's folder has one")
    with guard_reading(path):
        try:
            content = json.loads(path.read_bytes())
        except (ValueError, RecursionError) as error:
            raise FormatError(path, f"not JSON: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("values"), dict):
        raise FormatError(path, "has no 'values'; expected the shared.json of a film")
    values = content["values"]
    for name, value in values.items():
        if isinstance(value, dict) and "file" in value:
            values[name] = str((path.parent / value["file"]).absolute())
    return content


def fix(described: dict[str, Any], values: Mapping[str, Any], source: Path) -> None:
    """Puts the `values`, by variable, that `source` says into the scene `described`.

    They are not optimized any more. Raises UsageError where these are of other cameras or lights.
    """
    views = {view["name"]: view for view in described["views"]}
    lights = (f"lights.{index}" for index in range(len(described["lights"])))
    owners = {*lights, *(f"views.{name}" for name in views), *({"ground"} & {*described})}
    strange = [
        name
        for name in values
        if name.startswith(("views.", "lights.", "ground."))
        and name.rpartition(".")[0] not in owners
    ]
    if strange:
        raise UsageError(f"{source}: {strange[0]}: the scene has none; name that of its cameras")
    train = [name for name, view in views.items() if view["split"] == "train" and "image" in view]
    for name in [*described["optimize"]["parameters"]]:
        keys = [name.replace(EVERY, f"views.{view}.") for view in train]
        names = dict.fromkeys(keys if name.startswith(EVERY) else [name])
        missing = [key for key in names if key not in values]
        if missing and len(missing) < len(names):
            raise UsageError(f"{source}: has no {missing[0]}; name that of the scene's cameras")
        if not missing:
            del described["optimize"]["parameters"][name]
    put_values(described, values)
