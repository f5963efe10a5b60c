"""How fast parameters move: learning rates where a scene gives none, and their way over a run."""

from __future__ import annotations

from torch import Tensor

from ddrecon.scene import Scene
from ddrecon.variables.kinds import kind_of

WARM_UP = 5
"""Iterations over which learning rates rise to their value.

Adam's first steps are all of full size, whatever the derivative.
"""
FINAL_RATE = 0.2
"""Learning rates fall exponentially over a run, to this part of their value."""


def rate_at(iteration: int, iterations: int, begin: int = 0) -> float:
    """The part of their value that learning rates have in an iteration, in (0, 1].

    It is for parameters that move from iteration `begin` on, and 0 before. After the last of
    `iterations` it falls no more.
    """
    if iteration < begin:
        return 0.0
    made = iteration - begin
    warm_up: float = min(1.0, (made + 1) / WARM_UP)
    fall: float = FINAL_RATE ** min(1.0, made / (iterations - begin))
    return warm_up * fall


def default_rate(scene: Scene, name: str, start: Tensor) -> float | Tensor:
    """The learning rate of the parameter `name` of `scene`, which starts from `start`.

    It is the largest change in one step, of each entry where these differ in unit.
    """
    return kind_of(name).rate(scene, name, start)
