"""Default learning rates: the largest change of a variable in one step, in the variable's own unit.

Those of densities, cross sections, brightness, positions and directions follow the scene's units.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from ddrecon.medium.coefficients import Volume
    from ddrecon.scene import Scene, View

Rate = Callable[["Scene", str, "Tensor"], "float | Tensor"]
"""The rate of a variable by the scene, the variable's name and the value that it starts from.

It is one number, or one for each entry of the value.
"""

DENSITY_STEP = 0.1
"""Largest change of a density in one step; densities are usually of order 1."""
THICKEST_STEP = 8
"""Optical depth that one step may lay across the box; more, and the light is gone before the next
step can mend it.
"""
PIXELS = 0.25
"""Pixels by which one step of a camera's pose may move the image."""
EXPOSURE_STEP = 0.05
"""Change of an exposure in one step, as a part of it."""
OFFSET_STEP = 0.01
"""Change of an offset in one step, as a part of the root mean square of the picture."""
RELATIVE_STEP = 0.1
"""Change, in one step, of a quantity as a part of its mean, or of the box's shortest side."""


def density_rate(scene: Scene, name: str, start: Tensor) -> float:
    """`DENSITY_STEP`, or less in a box that would become thicker than `THICKEST_STEP`."""
    volume = scene.volume
    depth = float(volume.sigma_a.mean() + volume.sigma_s.mean()) * _side(volume)
    return min(DENSITY_STEP, THICKEST_STEP / depth) if depth > 0 else DENSITY_STEP


def cross_section_rate(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the mean [1/u], which counts as at least one over the box's shortest side."""
    return RELATIVE_STEP * max(float(start.mean()), 1 / _side(scene.volume))


def brightness_rate(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the mean, which counts as at least `RELATIVE_STEP`."""
    return RELATIVE_STEP * max(float(start.mean()), RELATIVE_STEP)


def position_rate(scene: Scene, name: str, start: Tensor) -> float:
    """A part of the box's shortest side [u]."""
    return RELATIVE_STEP * _side(scene.volume)


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


def fixed_rate(rate: float) -> Rate:
    """`rate` in every scene, for a variable with a natural unit."""
    return lambda scene, name, start: rate


def _view_of(scene: Scene, name: str) -> View:
    """The view that the variable `name`, `views.NAME.exposure`, belongs to."""
    return scene.view(name.partition(".")[2].rpartition(".")[0])


def _side(volume: Volume) -> float:
    """The box's shortest side [u]."""
    return min(volume.grid.extent)
