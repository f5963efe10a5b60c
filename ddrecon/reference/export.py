"""A scene as files that Mitsuba opens, for which Mitsuba is not needed.

They are XML, and beside it its volumes (.vol) and its environment map (.exr).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ddrecon.io.files.atomic import replace_file
from ddrecon.io.files.folders import require_free_files
from ddrecon.io.images.oiio import write_exr
from ddrecon.io.volumes.table import write_field
from ddrecon.reference.mitsuba_scene import mitsuba_scene
from ddrecon.scene import Scene

KINDS = {
    "volpath": "integrator",
    "volpathmis": "integrator",
    "perspective": "sensor",
    "orthographic": "sensor",
    "hdrfilm": "film",
    "box": "rfilter",
    "independent": "sampler",
    "heterogeneous": "medium",
    "gridvolume": "volume",
    "hg": "phase",
    "blendphase": "phase",
    "rayleigh": "phase",
    "tabphase": "phase",
    "cube": "shape",
    "null": "bsdf",
    "directional": "emitter",
    "point": "emitter",
    "constant": "emitter",
    "envmap": "emitter",
}
"""What Mitsuba's plugins are, which XML says and a dictionary does not."""
VECTORS = {"position": "point", "direction": "vector"}
NUMBERS: dict[type, str] = {bool: "boolean", int: "integer", float: "float", str: "string"}
Arrays = dict[Path, np.ndarray]
"""What belongs in files beside the XML."""


def export_scene(scene: Scene, path: Path, *, may_exist: bool) -> list[Path]:
    """Writes `scene` to `path` (.xml) and files named like it beside it; returns their paths.

    Raises UsageError where one exists and `may_exist` is False or the folder does not exist,
    SceneError for what Mitsuba cannot show.
    """
    arrays: Arrays = {}
    root = ElementTree.Element("scene", version="3.0.0")
    for key, value in mitsuba_scene(scene, scene.views).items():
        if key != "type":
            root.append(_element(key, value, "id", path, arrays))
    written = [path, *arrays]
    require_free_files(written, may_exist=may_exist)
    bounds = np.array(scene.volume.grid.bounds_xyz)
    for file, array in arrays.items():
        if array.ndim == 4:
            write_field(file, file.stem, array, bounds)
        else:
            write_exr(file, array)
    ElementTree.indent(root, "    ")
    with replace_file(path) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)
    return written


def _element(name: str, value: Any, naming: str, path: Path, arrays: Arrays) -> ElementTree.Element:
    """`value` as XML, called `name` in the attribute `naming`.

    What belongs in a file of its own is added to `arrays`.
    """
    if isinstance(value, dict):
        return _plugin(name, value, naming, path, arrays)
    if isinstance(value, tuple):
        return ElementTree.Element("rgb", name=name, value=_numbers(value))
    if isinstance(value, list):
        return ElementTree.Element(VECTORS[name], name=name, value=_numbers(value))
    if isinstance(value, np.ndarray):
        transform = ElementTree.Element("transform", name=name)
        ElementTree.SubElement(transform, "matrix", value=_numbers(value.ravel().tolist()))
        return transform
    return ElementTree.Element(
        NUMBERS[type(value)],
        name=name,
        value=str(value).lower() if isinstance(value, bool) else str(value),
    )


def _plugin(
    name: str, value: dict[str, Any], naming: str, path: Path, arrays: Arrays
) -> ElementTree.Element:
    if value["type"] == "ref":
        return ElementTree.Element("ref", name=name, id=value["id"])
    element = ElementTree.Element(KINDS[value["type"]], {"type": value["type"], naming: name})
    for key, entry in value.items():
        if isinstance(entry, np.ndarray) and entry.ndim > 2:
            file = path.with_name(f"{path.stem}.{name}{'.vol' if entry.ndim == 4 else '.exr'}")
            arrays[file] = entry
            key, entry = "filename", file.name
        if key != "type":
            element.append(_element(key, entry, "name", path, arrays))
    return element


def _numbers(values: Any) -> str:
    return ", ".join(repr(float(value)) for value in values)
