"""What a scene file may say of a light: one frozen record per kind, read as in `schema`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from ddrecon.grid import Triple
from ddrecon.settings import Problem, bounded, limited, one_of

Color = float | Triple


@dataclass(frozen=True)
class DirectionalSection:
    """`direction`: the way the light travels; `irradiance` on a plane facing it."""

    type: ClassVar[str] = "directional"

    direction: Triple
    irradiance: Color = limited(minimum=0)

    def problems(self) -> Iterator[Problem]:
        if not any(self.direction):
            yield "direction", "must not be zero"


@dataclass(frozen=True)
class AmbientSection:
    """The same radiance from everywhere."""

    type: ClassVar[str] = "ambient"

    radiance: Color = limited(minimum=0)


@dataclass(frozen=True)
class EnvironmentSection:
    """A latitude-longitude map whose pole is `up`.

    Its pixels are multiplied by `scale` and turned by `rotation` [degrees] about the pole.

    `directions`: how many directions its light on the volume is gathered into.
    """

    type: ClassVar[str] = "environment"

    file: Path
    scale: float = bounded(1.0, minimum=0)
    rotation: float = 0.0
    directions: int = bounded(48, minimum=1, maximum=1024)
    up: str = one_of("y", ("y", "z"))


@dataclass(frozen=True)
class PointSection:
    """Light from one point, inside or outside the box; `intensity`: power per solid angle."""

    type: ClassVar[str] = "point"

    position: Triple
    intensity: Color = limited(minimum=0)


LightSection = DirectionalSection | AmbientSection | EnvironmentSection | PointSection
