"""A scene as files that Mitsuba opens: XML, which Mitsuba itself writes, and what that names.

Beside it are its volumes (.vol) and pictures (.exr).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.io.files.atomic import replace_file
from ddrecon.io.files.folders import require_free_files
from ddrecon.io.images.oiio import write_exr
from ddrecon.io.volumes.table import write_field
from ddrecon.reference.mitsuba_scene import mitsuba_scene
from ddrecon.reference.trace import load_mitsuba, make_mitsuba_objects
from ddrecon.scene import Scene

Arrays = dict[Path, np.ndarray]
"""What is written to files beside the XML."""


def export_scene(scene: Scene, path: Path, *, may_exist: bool) -> list[Path]:
    """Writes `scene` to `path` (.xml) and files named like it beside it; returns their paths.

    Raises UsageError where one exists and `may_exist` is False or the folder does not exist,
    SceneError for what Mitsuba cannot show, MissingExtraError without Mitsuba.
    """
    module, arrays = load_mitsuba(), Arrays()
    described = _name_arrays(mitsuba_scene(scene, scene.views), "", path, arrays)
    written = [path, *arrays]
    require_free_files(written, may_exist=may_exist)
    bounds = np.array(scene.volume.grid.bounds_xyz)
    for file, array in arrays.items():
        if array.ndim == 4:
            write_field(file, file.stem, array, bounds)
        else:
            write_exr(file, array)
    config = module.parser.ParserConfig(module.variant())
    state = module.parser.parse_dict(config, make_mitsuba_objects(module, described))
    with replace_file(path) as temporary:
        module.parser.write_file(state, str(temporary))
    return written


def _name_arrays(described: dict[str, Any], name: str, path: Path, arrays: Arrays) -> Any:
    """`described`, the object called `name`, with names of files in place of pictures and volumes.

    They go to `arrays`.
    """
    named = dict[str, Any]()
    for key, value in described.items():
        if isinstance(value, np.ndarray) and value.ndim > 2:
            file = path.with_name(f"{path.stem}.{name}{'.vol' if value.ndim == 4 else '.exr'}")
            arrays[file], named["filename"] = value, file.name
        else:
            is_object = isinstance(value, dict)
            named[key] = _name_arrays(value, key, path, arrays) if is_object else value
    return named
