"""Default learning rates: the largest change of a variable in one step, in the variable's own unit.

Those of densities, cross sections, brightness, positions and directions follow the scene's units.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from ddrecon.medium.coefficients import Volume

Rate = Callable[[Volume, Tensor], float]
"""The rate of a variable, by the scene's volume and the value that the variable starts from."""

DENSITY_STEP = 0.1
"""Largest change of a density in one step; densities are usually of order 1."""
THICKEST_STEP = 8
"""Optical depth that one step may lay across the box; more, and the light is gone before the next
step can mend it.
"""
RELATIVE_STEP = 0.1
"""Change, in one step, of a quantity as a part of its mean, or of the box's shortest side."""


def density_rate(volume: Volume, start: Tensor) -> float:
    """`DENSITY_STEP`, or less in a box that would become thicker than `THICKEST_STEP`."""
    depth = float(volume.sigma_a.mean() + volume.sigma_s.mean()) * _side(volume)
    return min(DENSITY_STEP, THICKEST_STEP / depth) if depth > 0 else DENSITY_STEP


def cross_section_rate(volume: Volume, start: Tensor) -> float:
    """A part of the mean [1/u], which counts as at least one over the box's shortest side."""
    return RELATIVE_STEP * max(float(start.mean()), 1 / _side(volume))


def brightness_rate(volume: Volume, start: Tensor) -> float:
    """A part of the mean, which counts as at least `RELATIVE_STEP`."""
    return RELATIVE_STEP * max(float(start.mean()), RELATIVE_STEP)


def position_rate(volume: Volume, start: Tensor) -> float:
    """A part of the box's shortest side [u]."""
    return RELATIVE_STEP * _side(volume)


def direction_rate(volume: Volume, start: Tensor) -> float:
    """A part of the direction's length: a turn by some 3 degrees."""
    return RELATIVE_STEP / 2 * float(start.norm())


def fixed_rate(rate: float) -> Rate:
    """`rate` in every scene, for a variable with a natural unit."""
    return lambda volume, start: rate


def _side(volume: Volume) -> float:
    """The box's shortest side [u]."""
    return min(volume.grid.extent)
