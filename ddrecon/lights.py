"""Lights: radiance that arrives at the volume's box from outside. Vectors are (x, y, z); colors are `[1]` or `[3]`."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(eq=False)
class DirectionalLight:
    """Parallel light: `direction` [3] the way it travels (any length > 0), `irradiance` [C] on a plane facing it."""

    direction: Tensor
    irradiance: Tensor


@dataclass(eq=False)
class AmbientLight:
    """The same `radiance` [C] from every direction."""

    radiance: Tensor


Light = DirectionalLight | AmbientLight
