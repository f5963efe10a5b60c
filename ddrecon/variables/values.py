"""The numbers of a scene by name: read out of it, put back into it, and whether they are legal.

`density`, `sigma_a`, `sigma_s`, `sigma_t`, `albedo`, `g`, `phase.*` and, where it glows,
`emission` are the volume's; `lights.0.irradiance` is any number of the first light;
`ground.albedo` is the ground's; `views.front.camera` is the twist of a camera, `.focal`,
`.principal_point` and `.distortion` are its lens. Vectors are (x, y, z), colors lead.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from itertools import chain
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.cameras import twist
from ddrecon.errors import UsageError, nearest
from ddrecon.grid import Triple
from ddrecon.light.lights import Light
from ddrecon.medium.coefficients import Volume, for_cells, remix
from ddrecon.medium.phase import HenyeyGreenstein
from ddrecon.records import faults_of
from ddrecon.scene import Scene, View
from ddrecon.settings import LENSES
from ddrecon.variables.kinds import (
    CROSS_SECTIONS,
    EXTINCTION_AND_ALBEDO,
    PHASE,
    RESPONSE,
    STEEPEST_G,
    XYZ,
    is_of_volume,
    kind_of,
    split_name,
)

EVERY = "views.*."
"""How names for all training views at once begin: `views.*.exposure`."""
RIGID = 0.01
"""How far from 1 and 0 products of a pose's axes may be: optimizers and halves round."""
KEYS = tuple(key.name for key in fields(Scene) if key.name != "views")
Settings = TypeVar("Settings")


def variable_names(scene: Scene) -> list[str]:
    """The name of every variable of `scene`."""
    return [*find_readers(scene)]


def find_readers(scene: Scene) -> dict[str, Callable[[], Tensor]]:
    """What reads the value of each variable of `scene`, by name."""
    readers = find_volume_readers(scene.volume)
    for index, light in enumerate(scene.lights):
        keys = [key for key, value in vars(light).items() if isinstance(value, Tensor)]
        readers |= {f"lights.{index}.{key}": partial(getattr, light, key) for key in keys}
    if scene.ground is not None:
        readers["ground.albedo"] = partial(getattr, scene.ground, "albedo")
    for view in scene.views:
        owner = f"views.{view.name}."
        readers |= {owner + key: partial(_view_value, view, key) for key in _view_keys(view)}
    return readers


def find_volume_readers(volume: Volume) -> dict[str, Callable[[], Tensor]]:
    """The same of `volume`: its phase function has its own numbers, or g alone."""
    if volume.media is not None:
        return {
            f"media.{owner}.{name}": read
            for owner, medium in volume.media.items()
            for name, read in find_volume_readers(medium).items()
        }
    readers: dict[str, Callable[[], Tensor]] = {
        name: partial(getattr, volume, name) for name in ("density", *CROSS_SECTIONS)
    }
    readers |= {"sigma_t": partial(extinction_of, volume), "albedo": partial(_albedo_of, volume)}
    if volume.emission is not None:
        readers["emission"] = partial(getattr, volume, "emission")
    if isinstance(volume.phase, HenyeyGreenstein):
        return readers | {"g": partial(getattr, volume, "g")}
    numbers = volume.phase.variables
    readers |= {PHASE + name: partial(numbers.__getitem__, name) for name in numbers}
    return readers


def density_names(scene: Scene) -> list[str]:
    """The names of the density of `scene`, or of those of its two media."""
    return [name for name in find_volume_readers(scene.volume) if split_name(name)[1] == "density"]


def fields_of(scene: Scene) -> dict[str, Tensor]:
    """The variables that differ from cell to cell, [z, y, x] or of colors [C, z, y, x], by name."""
    readers = find_volume_readers(scene.volume).items()
    values = {name: read() for name, read in readers if kind_of(name).is_cellwise}
    return {name: value for name, value in values.items() if value.ndim >= 3}


def value_of(scene: Scene, name: str) -> Tensor:
    """The value of the variable `name`; raises UsageError for a name that is none.

    `density` [z, y, x]; cross sections and albedo [C] or [C, z, y, x]; numbers of phase functions
    and of lights as these hold them; a camera's twist is the change of its pose, [6] and zero: see
    `ddrecon.cameras.twist`. Its focal length [] is in widths of its image; exposure and offset are
    [1] or [3].
    """
    known = find_readers(scene)
    if name not in known:
        raise _unknown(scene, name)
    return known[name]()


def with_values(scene: Scene, values: Mapping[str, Tensor]) -> Scene:
    """`scene` with its variables replaced by `values`; `scene` itself stays as it is.

    A density of one number fills the grid. Of both pairs of cross sections, `sigma_t` and `albedo`
    are taken.

    Raises UsageError for a name that is none, and for another shape, precision or device than the
    scene's.
    """
    named, known = dict[str, Tensor](), find_readers(scene)
    for name, value in values.items():
        if name not in known:
            raise _unknown(scene, name)
        owner, last = split_name(name)
        if last == "density" and isinstance(value, Tensor) and value.ndim == 0:
            value = value.expand(scene.volume.grid.shape)
        like = owner + "sigma_a" if last in EXTINCTION_AND_ALBEDO else name
        require_form(name, value, known[like](), scene.volume.density, scene.volume.grid.shape)
        named[name] = value
    of_volume = {name: value for name, value in named.items() if is_of_volume(name)}
    lights: list[Light] = [
        replace(light, **_within(f"lights.{index}.", named))  # type: ignore[arg-type]
        for index, light in enumerate(scene.lights)
    ]
    ground = scene.ground
    if ground is not None and "ground.albedo" in named:
        ground = replace(ground, albedo=named["ground.albedo"])
    views = [_replace_view(view, named, scene.volume.grid.center_xyz) for view in scene.views]
    volume = _replace_volume(scene.volume, of_volume)
    return replace(scene, volume=volume, lights=lights, views=views, ground=ground)


def name_each(parameters: Mapping[str, Settings], views: Sequence[View]) -> dict[str, Settings]:
    """`parameters` with each name of all training views replaced by those of each of `views`.

    Views count that have an image and are not held out. What a view's own name says wins.
    """
    train = [view.name for view in views if view.image is not None and not view.is_test]
    named: dict[str, Settings] = {}
    for name, settings in parameters.items():
        if not name.startswith(EVERY):
            named[name] = settings
            continue
        for view in train:
            owner = f"views.{view}.{name.removeprefix(EVERY)}"
            named[owner] = parameters.get(owner, settings)
    return named


def shapes_of(scene: Scene, name: str) -> list[tuple[int, ...]]:
    """Those that the variable `name` of `scene` may have; raises as `value_of`."""
    is_pair = name in (*CROSS_SECTIONS, *EXTINCTION_AND_ALBEDO) and scene.volume.media is None
    shape = () if is_pair else tuple(value_of(scene, name).shape)
    return shapes_in_place(name, shape, scene.volume.grid.shape)


def shapes_in_place(
    name: str, shape: tuple[int, ...], cells: tuple[int, ...]
) -> list[tuple[int, ...]]:
    """The shapes that the variable `name` may have in place of its own `shape`."""
    kind, last = kind_of(name), split_name(name)[1]
    if last == "density":
        return [cells]
    if last.startswith(PHASE):
        return [shape, (), *((color, *tail) for color in (1, 3) for tail in ((), cells))]
    if kind.is_color:
        tails = [(), cells] if kind.is_cellwise else [shape[1:]]
        return [(color, *tail) for tail in tails for color in (1, 3)]
    if kind.is_cellwise:
        return [(), cells, (1, *cells)]
    return [(len(kind.components),)] if kind.components in (XYZ, XYZ[:2]) else [shape]


def require_form(
    name: str, value: Tensor, known: Tensor, like: Tensor, cells: tuple[int, ...]
) -> None:
    """Raises UsageError unless `value` can be the variable `name`, in place of `known`, on `cells`.

    Its precision and device are to be those of `like`. Nothing is read from a GPU.
    """
    if not isinstance(value, Tensor):
        raise UsageError(f"{name}: expected a tensor, found {type(value).__name__}")
    if not is_real(value):
        raise UsageError(f"{name}: is {value.dtype}, {value.layout}; expected real and strided")
    if (value.dtype, value.device) != (like.dtype, like.device):
        raise UsageError(
            f"{name}: is {value.dtype} on {value.device}, but the scene is {like.dtype} on "
            f"{like.device}; convert it by .to(...)"
        )
    require_shape(name, value, *shapes_in_place(name, tuple(known.shape), cells))


def require_shape(name: str, value: Tensor | None, *shapes: tuple[int, ...]) -> None:
    """Raises UsageError unless `value` is None or has one of `shapes`."""
    if value is not None and tuple(value.shape) not in shapes:
        expected = " or ".join(str(list(shape)) for shape in dict.fromkeys(shapes))
        raise UsageError(f"{name}: has shape {list(value.shape)}; expected {expected}")


def is_real(value: object) -> bool:
    """Whether `value` is a tensor of real numbers, each in its place."""
    return isinstance(value, Tensor) and value.layout == torch.strided and not value.is_complex()


def _unknown(scene: Scene, name: str) -> UsageError:
    names = variable_names(scene)
    components = [f"{n}.{c}" for n in names for c in component_names(n, value_of(scene, n))]
    if near := nearest(name, [*names, *components]):
        return UsageError(f"no variable {name!r}{near}")
    names = [known for known in names if not known.startswith("views.")]
    hint = f"besides views, the scene has {', '.join(names)}"
    if name == "emission":
        hint = "a volume has one where it is given, be it zero: volume.emission = torch.zeros(1)"
    return UsageError(f"no variable {name!r}; {hint}")


def component_names(name: str, value: Tensor) -> tuple[str, ...]:
    """The names along the first axis of `value`: a vector's entries or three colors; else none.

    Raises KeyError for a name of no variable.
    """
    kind = kind_of(name)
    if kind.is_color and value.shape[:1] == (3,):
        return ("r", "g", "b")
    return kind.components[: len(value)] if kind.components else ()


def cross_sections(sigma_t: Tensor, albedo: Tensor) -> tuple[Tensor, Tensor]:
    """sigma_a and sigma_s [1/u] of `sigma_t` and `albedo`, each `[C]` or `[C, z, y, x]`."""
    sigma_t, albedo = _same_axes(sigma_t, albedo)
    return sigma_t * (1 - albedo), sigma_t * albedo


def extinction_of(volume: Volume) -> Tensor:
    """sigma_t [1/u] of `volume`, `[C]` or `[C, z, y, x]`."""
    sigma_a, sigma_s = _same_axes(volume.sigma_a, volume.sigma_s)
    return sigma_a + sigma_s


def _same_axes(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Both as [C, z, y, x] if either is; a constant then has one cell."""
    is_even = first.ndim == second.ndim
    return (first, second) if is_even else (for_cells(first), for_cells(second))


def _albedo_of(volume: Volume) -> Tensor:
    sigma_t, (_, sigma_s) = extinction_of(volume), _same_axes(volume.sigma_a, volume.sigma_s)
    return sigma_s / sigma_t.clamp(min=torch.finfo(sigma_t.dtype).tiny)


def _replace_volume(volume: Volume, values: Mapping[str, Tensor]) -> Volume:
    if volume.media is not None:
        media = {
            name: _replace_volume(medium, _within(f"media.{name}.", values))
            for name, medium in volume.media.items()
        }
        return remix(volume, media)
    stored = {name: value for name, value in values.items() if name not in EXTINCTION_AND_ALBEDO}
    if len(stored) < len(values):
        readers = find_volume_readers(volume)
        sigma_t, albedo = (
            values[name] if name in values else readers[name]() for name in EXTINCTION_AND_ALBEDO
        )
        stored["sigma_a"], stored["sigma_s"] = cross_sections(sigma_t, albedo)
    phase = HenyeyGreenstein(stored.pop("g")) if "g" in stored else volume.phase
    if numbers := _within(PHASE, stored):
        phase = replace(phase, **numbers)
    stored = {name: value for name, value in stored.items() if not name.startswith(PHASE)}
    changed: Volume = replace(volume, phase=phase, **stored)  # type: ignore[arg-type]
    return changed


def _within(owner: str, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Those of `values` whose names begin with `owner`, by the rest of their names."""
    return {n.removeprefix(owner): value for n, value in values.items() if n.startswith(owner)}


def _view_keys(view: View) -> list[str]:
    lens = ["focal", "principal_point"] if view.camera.is_perspective else []
    lens += ["distortion"] if view.camera.distortion is not None else []
    return ["camera", *lens, *RESPONSE]


def _view_value(view: View, key: str) -> Tensor:
    camera, pose = view.camera, view.camera.pose
    if key == "camera":
        return pose.new_zeros(6)
    if key in RESPONSE:
        value = getattr(view, key)
        return pose.new_full((1,), RESPONSE[key]) if value is None else value
    value = 1 / (2 * camera.half_width) if key == "focal" else getattr(camera, key)
    return torch.as_tensor(value, dtype=pose.dtype, device=pose.device)


def _replace_view(view: View, values: Mapping[str, Tensor], center: Triple) -> View:
    owner = f"views.{view.name}."
    changes: dict[str, Any] = {
        key: values[owner + key] for key in _view_keys(view) if owner + key in values
    }
    if not changes:
        return view
    response = {key: changes.pop(key) for key in RESPONSE if key in changes}
    camera = view.camera
    if "camera" in changes:
        camera = twist(camera, changes.pop("camera"), center)
    if "focal" in changes:
        changes["half_width"] = 1 / (2 * changes.pop("focal"))
    return replace(view, camera=replace(camera, **changes) if changes else camera, **response)


def variation(scene: Scene, name: str) -> tuple[str, Tensor]:
    """The variable of `name`, and its change, of its value's shape, by one unit of `name`.

    `name` is a variable (`density`, `g`, `lights.0.irradiance`), all of whose entries change alike,
    or a component of one (`sigma_s.r`, `lights.0.direction.x`, `views.front.camera.rotation_y`).
    Directions, positions and cameras change by component only. Raises UsageError.
    """
    if name in variable_names(scene):
        value = value_of(scene, name)
        if components := kind_of(name).components:
            names = ", ".join(f"{name}.{component}" for component in components)
            raise UsageError(f"{name} changes by component: {names}")
        return name, torch.ones_like(value)
    owner, _, component = name.rpartition(".")
    if owner in variable_names(scene):
        value = value_of(scene, owner)
        components = component_names(owner, value)
        if component in components:
            change = torch.zeros_like(value)
            change[components.index(component)] = 1
            return owner, change
    raise _unknown(scene, name)


@contextmanager
def varied(scene: Scene, name: str | None) -> Iterator[Scene]:
    """`scene` in which `name`, as for `variation`, is a dual number while the block lasts, if any.

    Images of it have their derivative as a tangent. Raises UsageError.
    """
    if name is None:
        yield scene
        return
    variable, change = variation(scene, name)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(value_of(scene, variable), change)
        yield with_values(scene, {variable: dual})


def require_scene(scene: object) -> None:
    """Raises UsageError unless `scene` is one."""
    if not isinstance(scene, Scene):
        kind = type(scene).__name__
        raise UsageError(f"expected a Scene, found {kind}; ddrecon.load_scene(path) reads one")


def require_legal(scene: Scene, view: str | None = None) -> None:
    """Raises UsageError where a number of `scene` is none that a scene file may have.

    That is one of its volume, its lights or its views (of the one named `view`, or all) of a wrong
    type, shape, precision or device, one that is not finite, or out of range, such as a density
    below 0. Numbers on a GPU are not looked at: that would wait for them.
    """
    require_scene(scene)
    views = scene.views if view is None else [scene.view(view)]
    faults = faults_of(scene)
    if view is not None:
        faults = chain(faults_of(scene, keys=KEYS), faults_of(views[0], f"views.{view}"))
    for key, fault in faults:
        raise UsageError(f"{key}: {fault}")
    cells, density = scene.volume.grid.shape, scene.volume.density
    if density.is_meta:
        raise UsageError("density: has no numbers on the device meta")
    require_shape("volume.support", scene.volume.support, cells)
    for item in views:
        _require_view(item)
    for name, value in _numbers_of(scene, views).items():
        require_form(name, value, value, density, cells)
        if value.is_cpu:
            _require_range(name, value)


def _require_range(name: str, value: Tensor) -> None:
    """Raises UsageError where `value` is not finite, or out of range for the variable `name`."""
    kind = kind_of(name)
    least, most = (float(end) for end in value.detach().aminmax())
    range_found = f"found {least:g}" if least == most else f"found {least:g} to {most:g}"
    if not math.isfinite(least + most):
        raise UsageError(f"{name}: must be finite, {range_found}")
    limits, is_legal = kind.limits, kind.allows(value)
    if kind.high == STEEPEST_G:  # a scene may scatter further forward than a run makes it
        limits, is_legal = "above -1 and below 1", -1 < least <= most < 1
    if not is_legal:
        raise UsageError(f"{name}: must be {limits}, {range_found}")
    if kind.is_direction and least == most == 0:
        raise UsageError(f"{name}: must not be zero")


def _numbers_of(scene: Scene, views: Sequence[View]) -> dict[str, Tensor]:
    """All that can be varied of `scene` and its `views`, by name, as it is stored."""
    numbers: dict[str, object] = {
        name: read()
        for name, read in find_readers(scene).items()
        if not name.startswith("views.") and split_name(name)[1] not in EXTINCTION_AND_ALBEDO
    }
    for view in views:
        camera, owner = view.camera, f"views.{view.name}."
        numbers |= {owner + key: getattr(view, key) for key in RESPONSE}
        numbers |= {owner + "camera": camera.pose, owner + "distortion": camera.distortion}
        numbers[owner + "principal_point"] = camera.principal_point
    return {name: value for name, value in numbers.items() if isinstance(value, Tensor)}


def _require_view(view: View) -> None:
    """Raises UsageError where what is not varied of `view` cannot be: shapes, its pose and lens."""
    owner, camera, lens = f"views.{view.name}.", view.camera, view.camera.lens
    pose, half, size = camera.pose, torch.as_tensor(camera.half_width).detach(), camera.size
    require_shape(f"{owner}camera.pose", pose, (3, 4))
    if half.is_cpu and not 0 < float(half) < math.inf:
        rule = "half_width, 1 / (2 focal), must be above 0 and finite"
        raise UsageError(f"{owner}camera: {rule}, found {float(half):g}")
    if pose.is_cpu and not _is_rigid(pose.detach()):
        rule = "the first three columns of its pose must be of unit length and perpendicular"
        raise UsageError(f"{owner}camera: {rule}, and not mirror")
    if (lens is None) != (camera.distortion is None):
        raise UsageError(f"{owner}camera: give both lens and distortion, or neither")
    if lens is not None:
        require_shape(f"{owner}distortion", camera.distortion, (len(LENSES[lens]),))
    require_shape(f"{owner}image", view.image, (3, *size))
    require_shape(f"{owner}mask", view.mask, size)
    shapes = [(colors, *tail) for colors in (1, 3) for tail in ((1, 1), size)]
    require_shape(f"{owner}background", view.background, *shapes)
    behind = view.background
    if behind is not None and behind.is_cpu and not bool(behind.isfinite().all()):
        raise UsageError(f"{owner}background: must be finite")


def _is_rigid(pose: Tensor) -> bool:
    """Whether `pose` turns and shifts; NaN is for others to tell."""
    axes = pose[:, :3]
    off = (axes.T @ axes - torch.eye(3).to(pose)).abs().max()
    return not (float(off) > RIGID or float(axes.det()) < 0)
