"""Lights in Mitsuba's words, as `mitsuba_scene` has them.

Mitsuba takes one light from infinitely far all around, so ambient light is added to the pixels of
an environment map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.errors import SceneError
from ddrecon.light.environment import rotate_directions
from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light, PointLight


def mitsuba_lights(lights: Sequence[Light]) -> dict[str, dict[str, Any]]:
    """`lights` as Mitsuba's emitters, by names of their own.

    Raises SceneError for more than one environment map.
    """
    emitters: dict[str, dict[str, Any]] = {}
    ambient, maps = np.zeros(3), list[EnvironmentLight]()
    for index, light in enumerate(lights):
        if isinstance(light, DirectionalLight):
            emitters[f"light_{index}"] = {
                "type": "directional",
                "direction": light.direction.tolist(),
                "irradiance": _color(light.irradiance),
            }
        elif isinstance(light, PointLight):
            emitters[f"light_{index}"] = {
                "type": "point",
                "position": light.position.tolist(),
                "intensity": _color(light.intensity),
            }
        elif isinstance(light, AmbientLight):
            ambient = ambient + _color(light.radiance)
        else:
            maps.append(light)
    if len(maps) > 1:
        raise SceneError(
            f"the scene has {len(maps)} environment maps, and Mitsuba takes one; "
            "give it the one they sum to"
        )
    if maps:
        emitters["around"] = _environment(maps[0], ambient)
    elif ambient.any():
        emitters["around"] = {"type": "constant", "radiance": tuple(ambient.tolist())}
    return emitters


def _environment(light: EnvironmentLight, ambient: np.ndarray) -> dict[str, Any]:
    """The map turned as `ddrecon.light.environment` says, which holds `ambient` [3] as well."""
    radiance = (light.scale * light.radiance).detach().cpu().double().numpy()
    pixels = np.broadcast_to(radiance.transpose(1, 2, 0), (*radiance.shape[1:], 3)) + ambient
    turn = np.eye(4)
    turned = replace(light, rotation=light.rotation.detach().cpu().double())
    turn[:3, :3] = rotate_directions(torch.eye(3, dtype=torch.float64), turned).T
    return {"type": "envmap", "bitmap": np.ascontiguousarray(pixels, np.float32), "to_world": turn}


def _color(value: Tensor) -> tuple[float, ...]:
    return tuple(value.detach().cpu().expand(3).tolist())
