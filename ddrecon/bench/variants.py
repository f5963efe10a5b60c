"""What is varied: one setting at a time, from what the scene says."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from ddrecon.diffusion.closures import CLOSURES
from ddrecon.diffusion.solvers import SOLVERS
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.scene import Scene
from ddrecon.settings import DiffusionSettings


@dataclass(frozen=True)
class Sweep:
    """What is tried.

    These are tolerances of solves, models, transport rounds with degrees, steps a voxel,
    tolerances of interpolated pixels, and factors by which the grid is made coarser.
    """

    tolerances: tuple[float, ...] = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
    models: tuple[str, ...] = ("p1", "flux_limited")
    rounds: tuple[tuple[int, int], ...] = ((0, 3), (1, 3), (2, 3), (4, 3), (2, 5))
    steps: tuple[int, ...] = (1, 2)
    pixels: tuple[float, ...] = (0, 0.01, 0.05, 1)
    coarser: tuple[int, ...] = (2, 4)


QUICK = Sweep((1e-2, 1e-4, 1e-6), ("p1",), ((0, 3), (1, 3), (2, 3)), (1, 2), (0, 0.05), (2,))
EXACT: dict[str, Any] = {"solver": "multigrid", "tolerance": 1e-8, "warm_start": False}
EXACT_LIMITED = 1e-5
"""The tolerance in place of that for `flux_limited`.

Its damped iteration gains a digit in many minutes.
"""
EXACT_STEPS = 3


@dataclass(frozen=True)
class Variant:
    """One `factor` of a scene changed to `value`; the base, a scene as it is, has no factor."""

    factor: str
    value: str
    change: Callable[[Scene], Scene]

    @property
    def name(self) -> str:
        """As in tables: 'tolerance 0.01'."""
        return f"{self.factor} {self.value}".strip()


def variants_of(scene: Scene, sweep: Sweep) -> list[Variant]:
    """The base, and every variant of `sweep` that differs from it."""
    return [
        Variant("base", "", lambda scene: scene),
        *(item for item in _variants(sweep) if _settings(item.change(scene)) != _settings(scene)),
    ]


def exact_scene(scene: Scene) -> Scene:
    """`scene` by the same model on the same grid, solved as exactly as its precision allows.

    It is marched in finer steps, ray by ray.
    """
    steps = max(EXACT_STEPS, scene.render.steps)
    render = replace(scene.render, steps_per_voxel=steps, tolerance=0.0)
    diffusion = replace(scene.diffusion, **EXACT)
    if diffusion.model == "flux_limited":
        diffusion = replace(diffusion, tolerance=EXACT_LIMITED)
    return replace(scene, render=render, diffusion=diffusion)


def model_of(scene: Scene) -> tuple[object, ...]:
    """What two scenes must share for their exact images to be the same."""
    shape, _, diffusion = _settings(replace(scene, diffusion=replace(scene.diffusion, **EXACT)))
    return shape, diffusion


def _variants(sweep: Sweep) -> Iterator[Variant]:
    for name, values in (
        ("solver", SOLVERS),
        ("tolerance", sweep.tolerances),
        ("closure", CLOSURES),
        ("model", sweep.models),
    ):
        # Rounds are as many as the model has by default.
        more = {"transport_rounds": None} if name == "model" else {}
        yield from (_vary(name, value, "diffusion", {name: value, **more}) for value in values)
    for rounds, degree in sweep.rounds:
        changes = {"transport_rounds": rounds, "degree": degree}
        yield _vary("rounds", f"{rounds}, degree {degree}", "diffusion", changes)
    for steps in sweep.steps:
        yield _vary("steps", steps, "render", {"steps_per_voxel": steps})
    for tolerance in sweep.pixels:
        yield _vary("pixels", tolerance, "render", {"tolerance": tolerance})
    for factor in sweep.coarser:
        yield Variant("grid", f"{factor} times coarser", functools.partial(_coarsen, factor))


def _vary(factor: str, value: object, section: str, changes: dict[str, Any]) -> Variant:
    def change(scene: Scene) -> Scene:
        return replace(scene, **{section: replace(getattr(scene, section), **changes)})

    return Variant(factor, str(value), change)


def _coarsen(factor: int, scene: Scene) -> Scene:
    return replace(scene_at_level(scene, factor), views=scene.views)


def _settings(scene: Scene) -> tuple[object, ...]:
    """What is varied; without the degree where there are no rounds that it could matter to."""
    diffusion = scene.diffusion
    if not diffusion.rounds:
        diffusion = replace(diffusion, degree=DiffusionSettings.degree)
    return scene.volume.grid.shape, scene.render, diffusion
