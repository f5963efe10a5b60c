"""How long an iteration of a run takes, from a few at its coarsest resolutions."""

from __future__ import annotations

from time import perf_counter

from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.scene import Scene

BEGUN = 2
"""Iterations after which there is a medium, and kernels are compiled."""


def time_iteration(scene: Scene) -> float:
    """About how many seconds an iteration at the full resolution of `scene` takes.

    Cells and samples of view rays alike grow with the cells, so the time of an iteration is a line
    through those at the two coarsest levels of resolution. Raises DdreconError as a run does.
    """
    run, points = Reconstruction(scene), list[tuple[int, float]]()
    for _ in range(BEGUN):
        run.step()
    frame, levels = run.frames[0], len(run.problem.factors)
    for level in range(levels)[:2]:
        frame.enter(level)
        frame.evaluate()  # what is prepared once
        start = perf_counter()
        frame.evaluate()
        points.append((frame.level.train.volume.grid.cells, perf_counter() - start))
    (fewer, less), (more, longer) = points[0], points[-1]
    rate = max(longer - less, 0.0) / (more - fewer) if more > fewer else 0.0
    return longer + rate * (scene.volume.grid.cells - more)
