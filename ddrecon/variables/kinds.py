"""The table of variables: all that is known of each kind of number that can be optimized.

A kind is named by a pattern: N is the place in a list, counted from 0, and NAME a view's name, or
`*` for all training views. Where there are two media, `media.cloud.density` is of the same kind as
`density`. `ddrecon.variables.values` reads and replaces the values.

A kind knows a change of it that pictures show clearly, in the variable's own unit: differences are
taken over parts of it. Those of densities, cross sections, brightness, positions and directions
follow the scene's units.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ddrecon.settings import LENSES

if TYPE_CHECKING:
    from torch import Tensor

    from ddrecon.scene import Scene, View

Change = Callable[["Scene", str, "Tensor"], "float | Tensor"]
"""The change of a variable, or of each entry, by the scene, its name and its value."""

SOUGHT_DEPTH = 20.0
"""Optical depth that the densest medium may have across the box, where density is not known yet."""
PIXELS = 0.25
"""Pixels by which a change of a camera's pose moves the image."""
PART = 0.1
"""Change of a quantity as a part of its mean, or of the box's shortest side."""
LONG_STEPS = (1e-2, 1e-3, 1e-4)
"""Changes for finite differences, as parts of the variable's largest value."""
SHORT_STEPS = (1e-4, 1e-5, 1e-6)
"""The same for what moves rays or beams, since interpolation has a kink at every cell center, and
for g, whose delta-Eddington scaling has a second derivative that jumps at 0."""
STEEPEST_G = 0.99
"""Beyond this mean cosine of scattering the phase function is all peak."""
XYZ = ("x", "y", "z")


def cross_section_change(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the mean [1/u], which counts as at least what has an optical depth of 1."""
    return PART * max(float(start.mean()), unit_of(scene, name))


def brightness_change(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the mean, which counts as at least `PART`, seen from the box's side."""
    unit = _side(scene) ** 2 if name.endswith((".intensity", ".power")) else 1.0
    return PART * max(float(start.mean()), PART * unit)


def pose_change(scene: Scene, name: str, start: Tensor) -> Tensor:
    """What moves the image by `PIXELS` where the volume is: three turns [rad], three shifts [u].

    A turn about the box's center moves its corners, a shift along the axis makes it larger. A
    camera within the box counts as one at a face.
    """
    camera, grid = _view_of(scene, name).camera, scene.volume.grid
    radius = math.hypot(*grid.extent) / 2
    distance = float(camera.pose[:, 3].dist(camera.pose.new_tensor(grid.center_xyz)))
    distance = max(distance, _side(scene) / 2)
    pixel = 2 * float(camera.half_width) / camera.size[1]
    pixel, depth = (pixel * distance, distance / radius) if camera.is_perspective else (pixel, 1.0)
    turn = pixel / radius
    return PIXELS * start.new_tensor([turn, turn, turn, pixel, pixel, pixel * depth])


def offset_change(scene: Scene, name: str, start: Tensor) -> float:
    """A hundredth of the root mean square of the view's picture, or of 1 where there is none."""
    view = _view_of(scene, name)
    return 0.01 * (1.0 if view.image is None else float(view.seen.square().mean().sqrt()))


def side_change(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the box's shortest side [u]."""
    return PART * _side(scene)


def fixed_change(change: float) -> Change:
    """`change` in every scene, for a variable with a natural unit."""
    return lambda scene, name, start: change


def unit_of(scene: Scene, name: str) -> float:
    """The density, or cross section, of an optical depth of 1 across the box's shortest side.

    A density counts by the mean extinction of the medium of `name`, where there is any, a cross
    section by the largest density, or by `SOUGHT_DEPTH` where that is empty. An emission [radiance/
    u] looks as bright as the pictures of training views, weighted by themselves: black around what
    shines does not count. It is 1 where that is not known, and for other variables.
    """
    volume, side, kind = scene.volume, _side(scene), name.rpartition(".")[2]
    if kind == "emission":
        pictures = [
            view.seen for view in scene.views if view.image is not None and not view.is_test
        ]
        total = sum(float(image.mean()) for image in pictures)
        squares = sum(float(image.square().mean()) for image in pictures)
        return (squares / total if total > 0 else 1.0) / side
    if kind != "density" and not kind.startswith("sigma_"):
        return 1.0
    if volume.media is not None and name.startswith("media."):
        volume = volume.media[name.split(".")[1]]
    sigmas = volume.sigma_a, volume.sigma_s
    # Means count cells that have any.
    share = max(float(sigma.count_nonzero()) / sigma.numel() for sigma in sigmas) or 1.0
    depth = side * float(sum(sigma.mean() for sigma in sigmas)) / share
    unit = 1 / depth if depth > 0 else 1.0
    largest = float(volume.density.max()) or SOUGHT_DEPTH * unit
    return unit if kind == "density" else 1 / (side * largest)


def _view_of(scene: Scene, name: str) -> View:
    """The view that the variable `name`, `views.NAME.exposure`, belongs to."""
    return scene.view(name.partition(".")[2].rpartition(".")[0])


def _side(scene: Scene) -> float:
    """The box's shortest side [u]."""
    return min(scene.volume.grid.extent)


@dataclass(frozen=True)
class Kind:
    """One kind of variable.

    `change`: one that pictures show, of what may be a number; values are kept within [`low`,
    `high`]. `is_color`: values may differ by color, the leading axis; `is_cellwise`: by cell, the
    last three. `components`: names of a vector's entries, which change one at a time.
    `is_direction`: only where a vector points matters, and a step keeps its length. `tv`: the
    default weight of total variation, of `is_compressed` kinds that of the logarithm (E11.3), times
    `alone` where no other field is sought and it only suppresses noise. `difference_steps`: those
    of finite differences.
    """

    change: Change = fixed_change(1.0)
    low: float = -math.inf
    high: float = math.inf
    is_color: bool = False
    is_cellwise: bool = False
    components: tuple[str, ...] = ()
    is_direction: bool = False
    tv: float = 0.0
    alone: float = 1.0
    is_compressed: bool = False
    difference_steps: tuple[float, ...] = LONG_STEPS

    @property
    def limits(self) -> str:
        """Within what values are kept, in words."""
        most = "" if self.high == math.inf else f" and at most {self.high:g}"
        return f"at least {self.low:g}{most}"

    def allows(self, values: Tensor) -> bool:
        """Whether all `values` are within the limits."""
        return bool(((values >= self.low) & (values <= self.high)).all())


_CROSS_SECTION = Kind(cross_section_change, low=0, is_color=True, is_cellwise=True)
_SHARE = Kind(fixed_change(0.02), low=0, high=1, is_color=True)
_MEAN_COSINE = Kind(
    fixed_change(0.05), low=-STEEPEST_G, high=STEEPEST_G, difference_steps=SHORT_STEPS
)
_BRIGHTNESS = Kind(brightness_change, low=0, is_color=True)

KINDS: Mapping[str, Kind] = {
    "density": Kind(low=0, is_cellwise=True, tv=3e-3, is_compressed=True),
    "sigma_a": _CROSS_SECTION,
    "sigma_s": _CROSS_SECTION,
    "sigma_t": _CROSS_SECTION,
    # five brightnesses of the pictures, of what shines across the box's shortest side
    "emission": Kind(
        lambda scene, name, start: 5.0 * unit_of(scene, name),
        low=0,
        is_color=True,
        is_cellwise=True,
        tv=3e-3,
        alone=3.0,
        is_compressed=True,
    ),
    "albedo": replace(_SHARE, is_cellwise=True),
    "g": replace(_MEAN_COSINE, is_cellwise=True),
    "phase.g": _MEAN_COSINE,
    "phase.weight": replace(_SHARE, is_cellwise=True, change=fixed_change(0.05)),
    # of one of two media: the weight of their blend differs from cell to cell, and no other number
    "media.NAME.g": _MEAN_COSINE,
    "lights.N.irradiance": _BRIGHTNESS,
    "lights.N.radiance": _BRIGHTNESS,
    "lights.N.intensity": _BRIGHTNESS,
    "lights.N.power": _BRIGHTNESS,
    "lights.N.scale": Kind(brightness_change, low=0),
    # in degrees
    "lights.N.rotation": Kind(fixed_change(1.0), difference_steps=SHORT_STEPS),
    # a turn by some 3 degrees
    "lights.N.direction": Kind(
        lambda scene, name, start: PART / 2 * float(start.norm()),
        components=XYZ,
        is_direction=True,
        difference_steps=SHORT_STEPS,
    ),
    "lights.N.position": Kind(side_change, components=XYZ, difference_steps=SHORT_STEPS),
    "ground.albedo": _SHARE,
    "lights.N.radius": Kind(side_change, low=0, difference_steps=SHORT_STEPS),
    # a turn [rad] about the camera's own axes and a shift [u] along them: see ddrecon.cameras.twist
    "views.NAME.camera": Kind(
        pose_change,
        components=("rotation_x", "rotation_y", "rotation_z", *XYZ),
        difference_steps=SHORT_STEPS,
    ),
    # what a camera does to radiance: a factor, and what is added to it
    "views.NAME.exposure": Kind(
        lambda scene, name, start: 0.05 * float(start.mean()), low=1e-3, is_color=True
    ),
    "views.NAME.offset": Kind(offset_change, is_color=True),
    # of a perspective camera: its focal length in widths of the image, and the rest of its lens
    "views.NAME.focal": Kind(fixed_change(1e-3), low=1e-3, difference_steps=SHORT_STEPS),
    "views.NAME.principal_point": Kind(
        fixed_change(1e-3), components=("x", "y"), difference_steps=SHORT_STEPS
    ),
    "views.NAME.distortion": Kind(
        fixed_change(1e-3), components=LENSES["opencv"], difference_steps=SHORT_STEPS
    ),
}
"""Every kind of variable, by its pattern."""

FIELDS = tuple(name for name, kind in KINDS.items() if kind.is_cellwise)
"""Those that may differ from cell to cell."""
PHASE = "phase."
"""What variables of a phase function begin with, but `g` of Henyey and Greenstein's."""
CROSS_SECTIONS = ("sigma_a", "sigma_s")
EXTINCTION_AND_ALBEDO = ("sigma_t", "albedo")
PAIRS = (CROSS_SECTIONS, EXTINCTION_AND_ALBEDO)
"""Two ways to say the same: a scene gives and varies one pair, and the other follows."""
RESPONSE = {"exposure": 1.0, "offset": 0.0}
"""What a camera does to radiance, and what it is where a view has none (E9.1)."""


def is_of_volume(name: str) -> bool:
    """Whether the variable `name` is the volume's, and not of a light, the ground or a view."""
    return not name.startswith(("lights.", "ground.", "views."))


def kind_of(name: str) -> Kind:
    """The kind of the variable `name`; raises KeyError for a name of none."""
    kind = KINDS[pattern_of(name)]
    # A thin medium's share of scattering bends within small changes of the other medium.
    return replace(kind, difference_steps=SHORT_STEPS) if split_name(name)[0] else kind


def split_name(name: str) -> tuple[str, str]:
    """The medium that `name` is of, as `media.cloud.`, empty for none, and the rest of the name."""
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
