"""What can be optimized: for each kind of variable its legal values, and what a run assumes of it
unless the scene says otherwise.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """Values are kept within [`low`, `high`]; `is_color` if they may differ by color, `is_cellwise`
    if from cell to cell.

    `tv` is the weight of total variation where a scene gives none.
    """

    low: float = -math.inf
    high: float = math.inf
    is_color: bool = False
    is_cellwise: bool = False
    tv: float = 0.0


STEEPEST_G = 0.99
"""Beyond this mean cosine of scattering the phase function is all peak."""

_CROSS_SECTION = Kind(low=0, is_color=True, is_cellwise=True)
_BRIGHTNESS = Kind(low=0, is_color=True)
_FREE = Kind()

KINDS: Mapping[str, Kind] = {
    "density": Kind(low=0, is_cellwise=True, tv=3e-3),
    "sigma_a": _CROSS_SECTION,
    "sigma_s": _CROSS_SECTION,
    "sigma_t": _CROSS_SECTION,
    "albedo": Kind(low=0, high=1, is_color=True, is_cellwise=True),
    "g": Kind(low=-STEEPEST_G, high=STEEPEST_G),
    "lights.N.irradiance": _BRIGHTNESS,
    "lights.N.radiance": _BRIGHTNESS,
    "lights.N.intensity": _BRIGHTNESS,
    "lights.N.scale": Kind(low=0),
    "lights.N.rotation": _FREE,
    "lights.N.direction": _FREE,
    "lights.N.position": _FREE,
    "views.NAME.camera": _FREE,
}
"""By pattern of name: N is a light's place in the list, counted from 0, NAME a view's name."""


def pattern_of(name: str) -> str:
    """The pattern in `KINDS` that `name` follows, or `name` itself where it follows none."""
    if re.fullmatch(r"views\..+\.camera", name):
        return "views.NAME.camera"
    return re.sub(r"^lights\.[0-9]{1,9}\.", "lights.N.", name)
