"""Lights, as a user describes them.

Vectors are (x, y, z), colors `[1]` or `[3]`. Every tensor may be varied, in reverse and in forward
mode.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ddrecon.records import bounded, one_of


@dataclass(eq=False)
class DirectionalLight:
    """Parallel light.

    `direction` [3]: the way it travels, of any length > 0; `irradiance` [C]: on a plane facing it.
    """

    direction: Tensor
    irradiance: Tensor


@dataclass(eq=False)
class AmbientLight:
    """The same `radiance` [C] from every direction."""

    radiance: Tensor


@dataclass(eq=False)
class EnvironmentLight:
    """A latitude-longitude map of light from infinitely far away.

    `radiance` [C, h, w] >= 0 of every pixel, h >= 2 (`sky.py` says which lies where);
    `scale`: scalar factor on it; `rotation`: scalar, about the pole [degrees]; `directions`: how
    many regions the light on the volume is gathered into; `up`: y or z, where the pole is.
    """

    radiance: Tensor
    scale: Tensor
    rotation: Tensor
    directions: int = bounded(48, minimum=1)
    up: str = one_of("y", ("y", "z"))


@dataclass(eq=False)
class PointLight:
    """Light from one point, inside or outside the box.

    `position` [3] in u; `intensity` [C]: power per solid angle.
    """

    position: Tensor
    intensity: Tensor


@dataclass(eq=False)
class BeamLight:
    """A collimated Gaussian beam that comes from outside the box.

    `position` [3]: a point on its axis [u]; `direction` [3]: the way it travels, of any length > 0;
    `power` [C] of the whole beam; `radius` >= 0 [u]: scalar, where irradiance is 1/e^2 of that on
    the axis; 0 is a pencil, as thin as cells allow (`ddrecon.light.profile`).
    """

    position: Tensor
    direction: Tensor
    power: Tensor
    radius: Tensor


PlainLight = DirectionalLight | AmbientLight | PointLight | BeamLight
"""Lights that are not decomposed into others."""
Light = PlainLight | EnvironmentLight
BRIGHTNESS = ("irradiance", "radiance", "intensity", "power", "scale")
"""Their numbers that multiply the light they send."""
