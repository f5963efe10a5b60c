"""Scenes as files of Mitsuba's: ours written as XML, theirs as scene files of ours.

What Mitsuba opens is XML, which Mitsuba itself writes, beside volumes (.vol) and pictures (.exr).
What is imported is a grid volume in a cube, its lights and its cameras; what a plugin holds is
asked of the loaded scene, so that Mitsuba's own defaults count. Volumes are evaluated at the
centers of the cells of `sigma_t`.
"""

import math
import re
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ddrecon.errors import DataWarning, FormatError, SceneError
from ddrecon.io.files.atomic import replace_file
from ddrecon.io.files.folders import require_free_files
from ddrecon.io.files.reading import check_size, guard_reading
from ddrecon.io.images.oiio import write_exr
from ddrecon.io.volumes.table import write_field, write_fields
from ddrecon.reference.mitsuba_scene import LAMPS, MITSUBA_AXES, mitsuba_scene
from ddrecon.reference.trace import load_mitsuba, make_mitsuba_objects
from ddrecon.scene import Scene
from ddrecon.scene_file.load import dump_scene

TOLERANCE = 1e-4
"""By which matrices of a rotation, and boxes, relative to their size, may differ."""


def export_scene(scene: Scene, path: Path, *, may_exist: bool) -> list[Path]:
    """Writes `scene` to `path` (.xml) and files named like it beside it; returns their paths.

    Raises UsageError where one exists and `may_exist` is False or the folder does not exist,
    SceneError for what Mitsuba cannot show, MissingExtraError without Mitsuba.
    """
    module, arrays = load_mitsuba(), dict[Path, np.ndarray]()

    def name_arrays(described: dict[str, Any], owner: str) -> dict[str, Any]:
        """`described`, the object `owner`, with names of files for pictures and volumes."""
        named = dict[str, Any]()
        for key, value in described.items():
            if isinstance(value, np.ndarray) and value.ndim > 2:
                suffix = ".vol" if value.ndim == 4 else ".exr"
                file = path.with_name(f"{path.stem}.{owner}{suffix}")
                arrays[file], named["filename"] = value, file.name
            else:
                named[key] = name_arrays(value, key) if isinstance(value, dict) else value
        return named

    described = name_arrays(mitsuba_scene(scene, scene.views), "")
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


def import_scene(source: Path, path: Path, *, may_exist: bool) -> list[Path]:
    """Writes the Mitsuba scene in the file `source` (.xml) to `path` (.yaml), and its volume and
    its sky beside that; returns their paths.

    Raises FormatError for a file that Mitsuba refuses and for what we have no words for, UsageError
    where a file exists and `may_exist` is False, MissingExtraError without Mitsuba.
    """
    module = load_mitsuba()
    module.set_variant("scalar_rgb")
    with guard_reading(source):
        source.stat()
    stored, picture = (path.with_name(f"{path.stem}.{end}") for end in ("volume.npz", "sky.exr"))
    try:
        scene = module.load_file(str(source))
        volume, fields, bounds = _volume(module, scene)
        lights, sky = list[dict[str, Any]](), None
        for emitter in scene.emitters():
            lights.append(_light(module, emitter))
            if lights[-1]["type"] == "environment":
                sky, lights[-1]["file"] = lights[-1]["file"], picture.name
        views = [_view(module, sensor) for sensor in scene.sensors()]
    except (SceneError, RuntimeError) as error:
        # Mitsuba's own words begin with a place in its code.
        text = re.sub(r"^\[\w+\.cpp:\d+\]", "Mitsuba cannot load it:", str(error))
        raise FormatError(source, " ".join(text.split())) from error
    written = [path, stored, *([] if sky is None else [picture])]
    require_free_files(written, may_exist=may_exist)
    write_fields(stored, fields, bounds)
    if sky is not None:
        write_exr(picture, sky)
    volume |= {name: {"file": stored.name} for name in fields}
    dump_scene({"volume": volume, "lights": lights, "views": views}, path)
    return written


def _objects_of(module: ModuleType, plugin: Any) -> dict[str, Any]:
    """What `plugin` holds, by Mitsuba's names: numbers, and other plugins."""
    parameters = module.traverse(plugin)
    objects = {key: parameters[key] for key in parameters.keys()}  # noqa: SIM118  not a mapping

    class Callback(module.TraversalCallback):  # type: ignore[name-defined]
        def put(self, name: str, value: Any, *_: Any) -> None:
            if isinstance(value, module.Object):
                objects[name] = value

    plugin.traverse(Callback())
    return objects


def _volume(module: ModuleType, scene: Any) -> tuple[dict[str, Any], dict[str, Any], np.ndarray]:
    """The section of the volume, its fields [z, y, x] or [z, y, x, 3], and its box [2, 3]."""
    shapes = [shape for shape in scene.shapes() if shape.interior_medium()]
    if others := len(scene.shapes()) - len(shapes):
        warnings.warn(f"left out: {others} shapes without a medium inside", DataWarning, 3)
    if len(shapes) != 1 or shapes[0].class_name() != "Cube":
        raise SceneError(f"expected one cube with a medium inside, found {len(shapes)} such shapes")
    medium = _objects_of(module, shapes[0].interior_medium())
    grid, phase = medium["sigma_t"], medium["phase_function"]
    if grid.class_name() != "GridVolume":
        raise SceneError(f"sigma_t is a {grid.class_name()}; expected a gridvolume")
    bounds = np.array([grid.bbox().min, grid.bbox().max], np.float64).reshape(2, 3)
    corners = np.array(_objects_of(module, shapes[0])["vertex_positions"]).reshape(-1, 3)
    away = np.abs(corners - bounds[:, None]).min(0) / np.ptp(bounds, axis=0)
    if away.max() > TOLERANCE or (np.ptp(corners, axis=0) == 0).any():
        raise SceneError("the cube is not the box of its gridvolume, or does not lie along x, y, z")
    if phase.class_name() not in ("HGPhaseFunction", "IsotropicPhaseFunction"):
        raise SceneError(f"phase function {phase.class_name()}: only hg and isotropic are read")
    objects, scale = _objects_of(module, phase), float(medium["scale"])
    volume: dict[str, Any] = {"sigma_t": scale} | (
        {"g": float(objects["g"])} if "g" in objects else {}
    )
    fields = {"density": _evaluate(module, grid, grid, bounds)}
    if fields["density"].ndim == 4:  # by color
        fields, volume["density"] = {"sigma_t": fields["density"] * scale}, 1
    albedo = _evaluate(module, medium["albedo"], grid, bounds)
    colors = albedo.reshape(-1, albedo.shape[3] if albedo.ndim == 4 else 1)
    if np.ptp(colors, axis=0).any():
        fields["albedo"] = albedo
    else:
        volume["albedo"] = _plain(colors[0])
    return volume, fields, bounds


def _evaluate(module: ModuleType, volume: Any, grid: Any, bounds: np.ndarray) -> np.ndarray:
    """`volume` at the centers of the cells of `grid`, whose box `bounds` is."""
    cells = [int(count) for count in grid.resolution()]
    check_size(12 * math.prod(cells), Path("sigma_t"), "the volume")
    places = np.indices(cells[::-1])[::-1].reshape(3, -1).T + 0.5
    points = bounds[0] + places / cells * (bounds[1] - bounds[0])
    inside, values = module.Interaction3f(), np.empty(points.shape, np.float32)
    for cell, point in enumerate(points.tolist()):
        inside.p = point
        values[cell] = np.ravel(volume.eval(inside))
    values = values.reshape(*cells[::-1], 3)
    return values[..., 0] if (values == values[..., :1]).all() else values


def _light(module: ModuleType, emitter: Any) -> dict[str, Any]:
    """A light; the `file` of an environment map are its pixels [h, w, 3]."""
    objects, kind = _objects_of(module, emitter), emitter.class_name()

    def color(name: str) -> float | list[float]:
        return _plain(np.ravel(objects[name].eval(module.SurfaceInteraction3f())))

    for lamp in LAMPS.values():
        if kind == lamp.class_name:
            is_place = lamp.place in objects
            place = objects[lamp.place] if is_place else _matrix(objects["to_world"])[:3, 2]
            numbers = np.ravel(place).tolist()
            return {"type": lamp.plugin, lamp.place: numbers, lamp.color: color(lamp.color)}
    if kind == "ConstantBackgroundEmitter":
        return {"type": "ambient", "radiance": color("radiance")}
    if kind != "EnvironmentMapEmitter":
        raise SceneError(f"{kind}: only directional, constant, point and envmap are read")
    turn = _matrix(objects["to_world"])[:3, :3]
    up = "z" if abs(turn[2, 1]) > 0.5 else "y"
    level = np.array([turn[0], turn[2], -turn[1]]) if up == "z" else turn
    angle = math.atan2(level[0, 2], level[0, 0])
    cosine, sine = math.cos(angle), math.sin(angle)
    if np.abs(level - [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]).max() > TOLERANCE:
        raise SceneError("an envmap is turned about another axis than its pole, which is y or z")
    light = {"type": "environment", "scale": float(objects["scale"]), "up": up}
    # Mitsuba keeps a column more on both sides, so that the map wraps around.
    pixels = np.array(objects["data"], np.float32)[:, 1:-1]
    return light | {"rotation": math.degrees(angle), "file": pixels}


def _view(module: ModuleType, sensor: Any) -> dict[str, Any]:
    """A camera, with the size of its film."""
    objects, kind, film = _objects_of(module, sensor), sensor.class_name(), sensor.film()
    size = [int(count) for count in film.size()]
    if list(film.crop_size()) != size:
        raise SceneError(f"{sensor.id()}: the film is cropped")
    pose = _matrix(objects["to_world"]) * MITSUBA_AXES
    sides = np.linalg.norm(pose[:3, :3], axis=0)
    pose[:3, :3] /= sides
    camera: dict[str, Any] = {"matrix": pose.tolist(), "resolution": size}
    if kind == "PerspectiveCamera":
        offsets = (objects[f"principal_point_offset_{axis}"] for axis in "xy")
        middle = [0.5 - float(offset) for offset in offsets]
        fov = float(objects["x_fov"])
        camera |= {"type": "perspective", "fov": fov, "principal_point": middle}
    elif kind == "OrthographicCamera":
        aspect = float(sides[1] / sides[0])
        camera |= {"type": "orthographic", "width": 2 * float(sides[0]), "pixel_aspect": aspect}
    else:
        raise SceneError(f"{kind}: only perspective and orthographic cameras are read")
    name = re.sub(r"[^A-Za-z0-9_-]", "_", sensor.id())
    return ({"name": name} if name else {}) | {"camera": camera}


def _matrix(transform: Any) -> np.ndarray:
    """[4, 4] of a transform."""
    return np.array(transform.matrix, np.float64)


def _plain(color: np.ndarray) -> float | list[float]:
    numbers: list[float] = color.tolist()
    return numbers[0] if len(set(numbers)) == 1 else numbers
