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

PLUGINS = {
    "integrator": ("volpath", "volpathmis"),
    "sensor": ("perspective", "orthographic"),
    "film": ("hdrfilm",),
    "rfilter": ("box",),
    "sampler": ("independent",),
    "medium": ("heterogeneous",),
    "volume": ("gridvolume",),
    "phase": ("hg", "blendphase", "rayleigh", "tabphase"),
    "shape": ("cube", "rectangle"),
    "bsdf": ("null", "diffuse"),
    "texture": ("bitmap",),
    "emitter": ("directional", "point", "constant", "envmap"),
}
"""Mitsuba's plugins by what they are, which XML says and a dictionary does not."""
KINDS = {plugin: kind for kind, plugins in PLUGINS.items() for plugin in plugins}
VECTORS = {"position": "point", "direction": "vector"}
NUMBERS: dict[type, str] = {bool: "boolean", int: "integer", float: "float", str: "string"}
Arrays = dict[Path, np.ndarray]
"""Kinds that are written to files beside the XML."""


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
    """`value` as XML, its `name` in the attribute `naming`; what needs a file goes to `arrays`."""
    make = ElementTree.Element
    if isinstance(value, np.ndarray):
        transform = make("transform", name=name)
        transform.append(make("matrix", value=_numbers(value.ravel())))
        return transform
    if isinstance(value, tuple | list):
        kind = "rgb" if isinstance(value, tuple) else VECTORS[name]
        return make(kind, name=name, value=_numbers(value))
    if not isinstance(value, dict):
        text = str(value).lower() if isinstance(value, bool) else str(value)
        return make(NUMBERS[type(value)], name=name, value=text)
    if value["type"] == "ref":
        return make("ref", name=name, id=value["id"])
    element = make(KINDS[value["type"]], {"type": value["type"], naming: name})
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
