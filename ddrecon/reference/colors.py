"""One color of a scene as a gray scene.

Paths that red, green and blue share are chosen by the extinction of one of them and weighted for
the others. Where extinctions differ that makes five times the noise, and Mitsuba 3.9 drops samples
whose weight comes out a rounding below zero, so there each color is traced by itself.
"""

from __future__ import annotations

from dataclasses import fields, replace

from torch import Tensor

from ddrecon.medium.phase import PhaseFunction
from ddrecon.medium.phase_blend import Blend, TwoLobe
from ddrecon.scene import Scene


def pick_color(scene: Scene, color: int) -> Scene:
    """`scene` as seen in `color` alone: 0, 1, 2 for red, green, blue.

    Views keep their cameras only.
    """
    volume = scene.volume
    volume = replace(
        volume,
        sigma_a=_pick(volume.sigma_a, color),
        sigma_s=_pick(volume.sigma_s, color),
        phase=_pick_phase(volume.phase, color),
    )
    names = ("irradiance", "radiance", "intensity")
    lights = [
        replace(light, **{name: _pick(getattr(light, name), color)})  # type: ignore[arg-type]
        for light in scene.lights
        for name in names
        if hasattr(light, name)
    ]
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


def _pick(value: Tensor, color: int) -> Tensor:
    """The entry of `value` [C, ...] that belongs to `color`, still with a leading axis."""
    index = color % value.shape[0]
    return value[index : index + 1]
