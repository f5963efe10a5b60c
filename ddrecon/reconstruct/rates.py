"""How fast parameters move: learning rates where a scene gives none, and their way over a run."""

from __future__ import annotations

from torch import Tensor

from ddrecon.medium.coefficients import Volume
from ddrecon.scene import Scene
from ddrecon.variables.kinds import pattern_of

HASTE = 0.1
"""Largest change of a density in one step, unless the scene says otherwise; densities are usually
of order 1.
"""
THICKEST = 8
"""Optical depth that one step may lay across the box; more, and the light is gone before the next
step can mend it.
"""
WARM_UP = 5
"""Iterations over which learning rates rise to their value: Adam's first steps are all of full
size, whatever the derivative.
"""
FINAL_RATE = 0.2
"""Learning rates fall exponentially over a run, to this part of their value."""
SHARE = 0.1
"""Change, in one step, of a quantity as a part of its mean."""
ABSOLUTE = {"albedo": 0.02, "g": 0.05, "lights.N.rotation": 1.0, "views.NAME.camera": 0.01}
"""Change in one step of what has a natural unit: albedo and g, degrees, and radians or box sides.
"""


def rate_at(iteration: int, iterations: int) -> float:
    """The part of their value that learning rates have in an iteration, in (0, 1]."""
    warm_up: float = min(1.0, (iteration + 1) / WARM_UP)
    fall: float = FINAL_RATE ** (iteration / iterations)
    return warm_up * fall


def default_rate(scene: Scene, name: str, start: Tensor) -> float:
    """The learning rate of the parameter `name` of `scene`, which starts from `start`: its largest
    change in one step.
    """
    pattern, side = pattern_of(name), min(scene.volume.grid.extent)
    if pattern == "density":
        return _density_rate(scene.volume)
    if pattern in ABSOLUTE:
        return ABSOLUTE[pattern]
    if pattern == "lights.N.position":
        return SHARE * side
    if pattern == "lights.N.direction":
        return SHARE / 2 * float(start.norm())
    least = 1 / side if pattern.startswith("sigma") else SHARE
    return SHARE * max(float(start.mean()), least)


def _density_rate(volume: Volume) -> float:
    """HASTE, or a density of THICKEST optical depths across the box's shortest side where that is
    less.
    """
    depth = float(volume.sigma_a.mean() + volume.sigma_s.mean()) * min(volume.grid.extent)
    return min(HASTE, THICKEST / depth) if depth > 0 else HASTE
