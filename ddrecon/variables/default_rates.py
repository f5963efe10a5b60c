"""Default learning rates: the largest change of a variable in one step, in the variable's own unit.

Those of densities, cross sections, brightness, positions and directions follow the scene's units:
the same scene in other units of density or length moves alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from ddrecon.scene import Scene, View

Rate = Callable[["Scene", str, "Tensor"], "float | Tensor"]
"""The rate of a variable by the scene, the variable's name and the value that it starts from.

It is one number, or one for each entry of the value.
"""

DENSITY_STEP = 1.7
"""Optical depth that one step may lay across the box's shortest side."""
SOUGHT_DEPTH = 20.0
"""Optical depth that the densest medium may have across the box, where density is not known yet."""
PIXELS = 0.25
"""Pixels by which one step of a camera's pose may move the image."""
EXPOSURE_STEP = 0.05
"""Change of an exposure in one step, as a part of it."""
OFFSET_STEP = 0.01
"""Change of an offset in one step, as a part of the root mean square of the picture."""
RELATIVE_STEP = 0.1
"""Change, in one step, of a quantity as a part of its mean, or of the box's shortest side."""


def density_rate(scene: Scene, name: str, start: Tensor) -> float:
    """What has an optical depth of `DENSITY_STEP`."""
    return DENSITY_STEP * unit_of(scene, name)


def cross_section_rate(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the mean [1/u], which counts as at least what has an optical depth of 1."""
    return RELATIVE_STEP * max(float(start.mean()), unit_of(scene, name))


def brightness_rate(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the mean, which counts as at least `RELATIVE_STEP`, seen from the box's side."""
    unit = _side(scene) ** 2 if name.endswith(".intensity") else 1.0
    return RELATIVE_STEP * max(float(start.mean()), RELATIVE_STEP * unit)


def position_rate(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the box's shortest side [u]."""
    return RELATIVE_STEP * _side(scene)


def pose_rate(scene: Scene, name: str, start: Tensor) -> Tensor:
    """What moves the image by `PIXELS` where the volume is: three turns [rad], three shifts [u].

    A turn about the box's center moves its corners, a shift along the axis makes it larger.
    """
    camera, grid = _view_of(scene, name).camera, scene.volume.grid
    radius = math.hypot(*grid.extent) / 2
    distance = float(camera.pose[:, 3].dist(camera.pose.new_tensor(grid.center_xyz)))
    pixel = 2 * float(camera.half_width) / camera.size[1]
    pixel, depth = (pixel * distance, distance / radius) if camera.is_perspective else (pixel, 1.0)
    turn = pixel / radius
    return PIXELS * start.new_tensor([turn, turn, turn, pixel, pixel, pixel * depth])


def exposure_rate(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the exposure."""
    return EXPOSURE_STEP * float(start.mean())


def offset_rate(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the root mean square of the view's picture, or of 1 where there is none."""
    image = _view_of(scene, name).image
    return OFFSET_STEP * (1.0 if image is None else float(image.square().mean().sqrt()))


def direction_rate(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the direction's length: a turn by some 3 degrees."""
    return RELATIVE_STEP / 2 * float(start.norm())


def unit_of(scene: Scene, name: str) -> float:
    """The density, or cross section, of an optical depth of 1 across the box's shortest side.

    `name` is the variable's: a density counts by the mean extinction of its own medium, a cross
    section by the largest density of its own, or by `SOUGHT_DEPTH` where that is empty. 1 where
    neither is known, and for other variables.
    """
    volume, side, kind = scene.volume, _side(scene), name.rpartition(".")[2]
    if volume.media is not None and name.startswith("media."):
        volume = volume.media[name.split(".")[1]]
    if kind == "density" or kind.startswith("sigma_"):
        depth = side * float(volume.sigma_a.mean() + volume.sigma_s.mean())
        unit = 1 / depth if depth > 0 else 1.0
        largest = float(volume.density.max()) or SOUGHT_DEPTH * unit
        return unit if kind == "density" else 1 / (side * largest)
    return 1.0


def fixed_rate(rate: float) -> Rate:
    """`rate` in every scene, for a variable with a natural unit."""
    return lambda scene, name, start: rate


def _view_of(scene: Scene, name: str) -> View:
    """The view that the variable `name`, `views.NAME.exposure`, belongs to."""
    return scene.view(name.partition(".")[2].rpartition(".")[0])


def _side(scene: Scene) -> float:
    """The box's shortest side [u]."""
    return min(scene.volume.grid.extent)
