"""One color of a scene as a gray scene.

Paths that red, green and blue share are chosen by the extinction of one of them and weighted for
the others. Where extinctions differ that makes five times the noise, and Mitsuba 3.9 drops samples
whose weight comes out a rounding below zero, so there each color is traced by itself.
"""

from __future__ import annotations

from dataclasses import fields, replace

from torch import Tensor

from ddrecon.light.lights import AmbientLight, DirectionalLight, EnvironmentLight, Light
from ddrecon.medium.phase import PhaseFunction
from ddrecon.medium.phase_blend import Blend, TwoLobe
from ddrecon.scene import Scene


def pick_color(scene: Scene, color: int) -> Scene:
    """`scene` as seen in `color` alone: 0, 1, 2 for red, green, blue.

    Views keep their cameras only.
    """
    volume = replace(
        scene.volume,
        sigma_a=_pick(scene.volume.sigma_a, color),
        sigma_s=_pick(scene.volume.sigma_s, color),
        phase=_pick_phase(scene.volume.phase, color),
    )
    lights = [_pick_light(light, color) for light in scene.lights]
    return replace(scene, volume=volume, lights=lights)


def _pick_phase(phase: PhaseFunction, color: int) -> PhaseFunction:
    if phase.colors == 1:
        return phase
    if isinstance(phase, Blend):
        first, second = (_pick_phase(part, color) for part in phase.parts)
        return replace(phase, first=first, second=second, weight=_pick_number(phase.weight, color))
    shared = "g" if isinstance(phase, TwoLobe) else ""
    names = [field.name for field in fields(phase) if field.name != shared]
    return replace(phase, **{name: _pick_number(getattr(phase, name), color) for name in names})


def _pick_number(number: Tensor, color: int) -> Tensor:
    """Of a `number` by color [3] or [3, z, y, x] that one's; else the number as it is."""
    return number if number.ndim in (0, 3) else _pick(number, color)


def _pick_light(light: Light, color: int) -> Light:
    if isinstance(light, DirectionalLight):
        return replace(light, irradiance=_pick(light.irradiance, color))
    if isinstance(light, AmbientLight):
        return replace(light, radiance=_pick(light.radiance, color))
    if isinstance(light, EnvironmentLight):
        return replace(light, radiance=_pick(light.radiance, color))
    return replace(light, intensity=_pick(light.intensity, color))


def _pick(value: Tensor, color: int) -> Tensor:
    """The entry of `value` [C, ...] that belongs to `color`, still with a leading axis."""
    index = color % value.shape[0]
    return value[index : index + 1]
