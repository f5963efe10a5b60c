"""The numbers of a scene by name, read out of a scene and put back into it.

`density`, `sigma_a`, `sigma_s`, `sigma_t`, `albedo` and `g` are the volume's; `lights.0.irradiance`
is any number of the first light; `views.front.camera` is the twist of a camera. Vectors are (x, y,
z), colors lead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from ddrecon.cameras import twist
from ddrecon.light.lights import Light
from ddrecon.medium.coefficients import Volume
from ddrecon.scene import Scene, View
from ddrecon.variables.kinds import EXTINCTION_AND_ALBEDO, VOLUME, kind_of

VIEW: Mapping[str, Callable[[View], Tensor]] = {
    "camera": lambda view: view.camera.pose.new_zeros(6),
    "exposure": lambda view: _or_fill(view.exposure, view, 1.0),
    "offset": lambda view: _or_fill(view.offset, view, 0.0),
}
"""The variables of a view, and what reads each."""


def variable_names(scene: Scene) -> list[str]:
    """The name of every variable of `scene`."""
    lights = [
        f"lights.{index}.{name}"
        for index, light in enumerate(scene.lights)
        for name in _tensors(light)
    ]
    views = [f"views.{view.name}.{key}" for view in scene.views for key in VIEW]
    return [*VOLUME, *lights, *views]


def value_of(scene: Scene, name: str) -> Tensor:
    """The value of the variable `name`; raises KeyError for a name that is none.

    `density` [z, y, x]; cross sections and albedo [C] or [C, z, y, x]; `g` and a light's numbers as
    that light holds them; a camera's twist is the change of its pose, [6] and zero: see
    `ddrecon.cameras.twist`; exposure and offset [1] or [3].
    """
    if name not in variable_names(scene):
        raise KeyError(name)
    if name in VOLUME:
        return _volume_value(scene.volume, name)
    section, _, path = name.partition(".")
    if section == "views":
        owner, _, key = path.rpartition(".")
        return VIEW[key](scene.view(owner))
    index, _, attribute = path.partition(".")
    value: Tensor = getattr(scene.lights[int(index)], attribute)
    return value


def with_values(scene: Scene, values: Mapping[str, Tensor]) -> Scene:
    """`scene` with its variables replaced by `values`; `scene` itself stays as it is.

    A density of one number fills the grid.

    Raises KeyError for a name that is none, ValueError for a density of another shape than the
    grid's.
    """
    known = variable_names(scene)
    unknown = [name for name in values if name not in known]
    if unknown:
        raise KeyError(f"no variable {unknown[0]!r}; the scene has {', '.join(known)}")
    lights = [
        _replace_light(light, f"lights.{index}", values) for index, light in enumerate(scene.lights)
    ]
    views = [_replace_view(view, values, scene) for view in scene.views]
    volume = _replace_volume(
        scene.volume, {name: values[name] for name in VOLUME if name in values}
    )
    return replace(scene, volume=volume, lights=lights, views=views)


def component_names(name: str, value: Tensor) -> tuple[str, ...]:
    """The names along the first axis of `value`: a vector's entries or three colors; else none.

    Raises KeyError for a name of no variable.
    """
    kind = kind_of(name)
    return ("r", "g", "b") if kind.is_color and value.shape[:1] == (3,) else kind.components


def cross_sections(sigma_t: Tensor, albedo: Tensor) -> tuple[Tensor, Tensor]:
    """sigma_a and sigma_s [1/u] of `sigma_t` and `albedo`, each `[C]` or `[C, z, y, x]`."""
    sigma_t, albedo = _same_axes(sigma_t, albedo)
    return sigma_t * (1 - albedo), sigma_t * albedo


def _same_axes(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """Both as [C, z, y, x] if either is; a constant then has one cell."""
    if one.ndim == other.ndim:
        return one, other
    return (one, other.view(-1, 1, 1, 1)) if one.ndim == 4 else (one.view(-1, 1, 1, 1), other)


def _or_fill(value: Tensor | None, view: View, default: float) -> Tensor:
    return view.camera.pose.new_full((1,), default) if value is None else value


def _tensors(light: Light) -> list[str]:
    """The names of the numbers of `light` that can be varied."""
    return [field.name for field in fields(light) if isinstance(getattr(light, field.name), Tensor)]


def _volume_value(volume: Volume, name: str) -> Tensor:
    if name not in EXTINCTION_AND_ALBEDO:
        value: Tensor = getattr(volume, name)
        return value
    sigma_a, sigma_s = _same_axes(volume.sigma_a, volume.sigma_s)
    sigma_t = sigma_a + sigma_s
    if name == "sigma_t":
        return sigma_t
    return sigma_s / sigma_t.clamp(min=torch.finfo(sigma_t.dtype).tiny)


def _replace_volume(volume: Volume, values: Mapping[str, Tensor]) -> Volume:
    stored = {name: value for name, value in values.items() if name not in EXTINCTION_AND_ALBEDO}
    if len(stored) < len(values):
        sigma_t, albedo = (
            values[name] if name in values else _volume_value(volume, name)
            for name in EXTINCTION_AND_ALBEDO
        )
        stored["sigma_a"], stored["sigma_s"] = cross_sections(sigma_t, albedo)
    if "density" in stored and stored["density"].ndim == 0:
        stored["density"] = stored["density"].expand(volume.grid.shape)
    changed: Volume = replace(volume, **stored)  # type: ignore[arg-type]
    return changed


def _replace_light(light: Light, name: str, values: Mapping[str, Tensor]) -> Light:
    tensors = {key: values[f"{name}.{key}"] for key in _tensors(light) if f"{name}.{key}" in values}
    changed: Light = replace(light, **tensors)  # type: ignore[arg-type]
    return changed


def _replace_view(view: View, values: Mapping[str, Tensor], scene: Scene) -> View:
    names = {key: f"views.{view.name}.{key}" for key in VIEW}
    changes: dict[str, Any] = {key: values[name] for key, name in names.items() if name in values}
    if "camera" in changes:
        changes["camera"] = twist(view.camera, changes["camera"], scene.volume.grid.center_xyz)
    return replace(view, **changes) if changes else view
