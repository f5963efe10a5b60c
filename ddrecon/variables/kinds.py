"""The table of variables: all that is known of each kind of number that can be optimized.

A kind is named by a pattern: N is the place in a list, counted from 0, and NAME a view's name, or
`*` for all training views. Where there are two media, `media.cloud.density` is of the same kind as
`density`. `ddrecon.variables.values` reads and replaces the values.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from ddrecon.settings import LENSES
from ddrecon.variables.default_rates import (
    Rate,
    brightness_rate,
    cross_section_rate,
    density_rate,
    direction_rate,
    exposure_rate,
    fixed_rate,
    offset_rate,
    pose_rate,
    position_rate,
)

LONG_STEPS = (1e-2, 1e-3, 1e-4)
"""Changes by which finite differences are taken, as parts of the variable's largest value."""
SHORT_STEPS = (1e-4, 1e-5, 1e-6)
"""The same for what moves rays or beams, since interpolation has a kink at every cell center and a
short step crosses few, and for g, whose delta-Eddington scaling has a second derivative that jumps
at 0.
"""
STEEPEST_G = 0.99
"""Beyond this mean cosine of scattering the phase function is all peak."""
XYZ = ("x", "y", "z")


@dataclass(frozen=True)
class Kind:
    """One kind of variable.

    `rate` is the default learning rate; values are kept within [`low`, `high`]. `is_color`: they
    may differ by color, the leading axis; `is_cellwise`: by cell, the last three. `components` are
    the names of a vector's entries, which change one at a time. `is_direction`: only the way a
    vector points matters, and a step keeps its length. `tv` is the default weight of total
    variation, taken of what `losses.compress` makes of one that `is_compressed`;
    `difference_steps` are those of finite differences. `release` is the part of a run after which
    the variable begins to move where fields are sought, of which a lamp would learn wrong things
    while they are empty.
    """

    rate: Rate
    low: float = -math.inf
    high: float = math.inf
    is_color: bool = False
    is_cellwise: bool = False
    components: tuple[str, ...] = ()
    is_direction: bool = False
    tv: float = 0.0
    is_compressed: bool = False
    difference_steps: tuple[float, ...] = LONG_STEPS
    release: float = 0.0


_CROSS_SECTION = Kind(cross_section_rate, low=0, is_color=True, is_cellwise=True)
_MEAN_COSINE = Kind(
    fixed_rate(0.05), low=-STEEPEST_G, high=STEEPEST_G, difference_steps=SHORT_STEPS
)
_LOBE_WEIGHT = Kind(fixed_rate(0.05), low=0, high=1, is_color=True, is_cellwise=True)
_BRIGHTNESS = Kind(brightness_rate, low=0, is_color=True, release=0.3)

KINDS: Mapping[str, Kind] = {
    "density": Kind(density_rate, low=0, is_cellwise=True, tv=3e-3, is_compressed=True),
    "sigma_a": _CROSS_SECTION,
    "sigma_s": _CROSS_SECTION,
    "sigma_t": _CROSS_SECTION,
    "albedo": Kind(fixed_rate(0.02), low=0, high=1, is_color=True, is_cellwise=True),
    "g": replace(_MEAN_COSINE, is_cellwise=True),
    "phase.g": _MEAN_COSINE,
    "phase.weight": _LOBE_WEIGHT,
    # of one of two media: the weight of their blend differs from cell to cell, and no other number
    "media.NAME.g": _MEAN_COSINE,
    "lights.N.irradiance": _BRIGHTNESS,
    "lights.N.radiance": _BRIGHTNESS,
    "lights.N.intensity": _BRIGHTNESS,
    "lights.N.scale": Kind(brightness_rate, low=0, release=0.3),
    # in degrees
    "lights.N.rotation": Kind(fixed_rate(1.0), difference_steps=SHORT_STEPS),
    "lights.N.direction": Kind(
        direction_rate, components=XYZ, is_direction=True, difference_steps=SHORT_STEPS
    ),
    "lights.N.position": Kind(position_rate, components=XYZ, difference_steps=SHORT_STEPS),
    # a turn [rad] about the camera's own axes and a shift [u] along them: see ddrecon.cameras.twist
    "views.NAME.camera": Kind(
        pose_rate,
        components=("rotation_x", "rotation_y", "rotation_z", *XYZ),
        difference_steps=SHORT_STEPS,
    ),
    # what a camera does to radiance: a factor, and what is added to it
    "views.NAME.exposure": Kind(exposure_rate, low=1e-3, is_color=True),
    "views.NAME.offset": Kind(offset_rate, is_color=True),
    # of a perspective camera: its focal length in widths of the image, and the rest of its lens
    "views.NAME.focal": Kind(fixed_rate(1e-3), low=1e-3, difference_steps=SHORT_STEPS),
    "views.NAME.principal_point": Kind(
        fixed_rate(1e-3), components=("x", "y"), difference_steps=SHORT_STEPS
    ),
    "views.NAME.distortion": Kind(
        fixed_rate(1e-3), components=LENSES["opencv"], difference_steps=SHORT_STEPS
    ),
}
"""Every kind of variable, by its pattern."""

FIELDS = tuple(name for name, kind in KINDS.items() if kind.is_cellwise)
"""Those that may differ from cell to cell."""
PHASE = "phase."
"""What variables of a phase function begin with; `phase.g` of Henyey and Greenstein's is `g`."""
CROSS_SECTIONS = ("sigma_a", "sigma_s")
EXTINCTION_AND_ALBEDO = ("sigma_t", "albedo")
PAIRS = (CROSS_SECTIONS, EXTINCTION_AND_ALBEDO)
"""Two ways to say the same: a scene gives and varies one pair, and the other follows."""


def is_of_volume(name: str) -> bool:
    """Whether the variable `name` is the volume's, and not of a light or a view."""
    return not name.startswith(("lights.", "views."))


def kind_of(name: str) -> Kind:
    """The kind of the variable `name`; raises KeyError for a name of none."""
    kind = KINDS[pattern_of(name)]
    # A thin medium's share of scattering bends within small changes of the other medium.
    return replace(kind, difference_steps=SHORT_STEPS) if split_name(name)[0] else kind


def split_name(name: str) -> tuple[str, str]:
    """The medium that the variable `name` is of, as `media.cloud.`, and the rest of its name.

    The first is empty where it is of no medium.
    """
    match = re.fullmatch(r"(media\.[^.]+\.)?(.*)", name)
    assert match is not None
    return match[1] or "", match[2]


def pattern_of(name: str) -> str:
    """The pattern in `KINDS` that `name` follows, or `name` itself where it follows none."""
    if match := re.fullmatch(r"views\..+\.([a-z_]+)", name):
        return f"views.NAME.{match[1]}"
    medium, name = split_name(name)
    if medium and name == "g":
        return "media.NAME.g"
    return re.sub(r"^lights\.[0-9]{1,9}\.", "lights.N.", name)
