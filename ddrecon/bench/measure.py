"""Time and error of each variant's image, and of the gradient of its mean by density.

Variants take turns. The numerical error is against the same model solved exactly, in double
precision; the whole error is against path tracing by Mitsuba 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.closures import CLOSURES
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import SolveError
from ddrecon.picture import render_each
from ddrecon.progress import Progress, table_lines
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.reference.trace import Traced, Tracer, error_text, least_error
from ddrecon.scene import Scene
from ddrecon.validate.hard import relative_error
from ddrecon.variables.values import with_values

EXACT: dict[str, Any] = {"tolerance": 1e-8, "warm_start": False}
EXACT_STEPS = 3
TURNS = 2
PATHS, QUICK_PATHS = (4, 16, 64), (4, 16)
"""Paths a pixel that Mitsuba is tried with."""
TRUTH_PASSES, TRUTH_SEED = 4, 1000
"""The truth is the mean of so many images of the most paths, whose seeds begin here."""
HEAD: tuple[str, ...] = ("variant", "image s", "+ gradient s", "times base", "iterations")
HEAD += ("image num. error", "gradient num. error", "image error", "")


@dataclass(frozen=True)
class Shot:
    """One image [3, h, w] of a scene's first view, and the `gradient` [z, y, x] of its mean by
    density, None of path tracing. `iterations` are the first solve's, or samples a pixel.
    """

    image: Tensor
    gradient: Tensor | None
    image_seconds: float
    gradient_seconds: float
    iterations: int


@dataclass(frozen=True)
class Row:
    """One variant, or path tracing; errors are relative RMS, None where nothing is to compare with.

    Seconds are medians, `both_seconds` of image and gradient. `image_numerical` and
    `gradient_numerical` are against the same model solved exactly; `image_error` is against path
    tracing, whose `image_noise` is subtracted in quadrature. `is_best`: no other row is known to be
    faster and as close to the truth.
    """

    name: str
    image_seconds: float
    both_seconds: float
    iterations: int
    image_numerical: float | None = None
    gradient_numerical: float | None = None
    image_error: float | None = None
    image_noise: float = 0.0
    is_best: bool = False

    @property
    def error(self) -> float:
        """The error against path tracing, at least what that can tell from none, or else against
        the exact solution, or else infinity.
        """
        if self.image_error is not None:
            return max(self.image_error, least_error(self.image_noise))
        return math.inf if self.image_numerical is None else self.image_numerical

    def cells(self, base: Row) -> list[str]:
        """What a table has of the row; times are multiples of those of `base`."""
        numerical = self.image_numerical, self.gradient_numerical
        noisy = "" if self.image_error is None else error_text(self.image_error, self.image_noise)
        return [
            *(self.name, f"{self.image_seconds:.3f}", f"{self.both_seconds:.3f}"),
            *(f"{self.both_seconds / base.both_seconds:.2f}", str(self.iterations)),
            *("" if error is None else f"{error:.1e}" for error in numerical),
            *(noisy, "best" if self.is_best else ""),
        ]


def with_best(rows: Sequence[Row]) -> list[Row]:
    """The same rows, those marked that no other beats in both time of an image and error."""

    def is_beaten(row: Row) -> bool:
        return any(o.image_seconds < row.image_seconds and o.error <= row.error for o in rows)

    return [replace(row, is_best=not is_beaten(row)) for row in rows]


def bench_lines(rows: Sequence[Row]) -> list[str]:
    """The rows as a Markdown table, and Mitsuba's time."""
    base, last = rows[0], rows[-1]
    lines = table_lines(HEAD, [row.cells(base) for row in rows])
    if last.image_error is not None:
        times = last.image_seconds / base.image_seconds
        lines.append(
            f"image error is against path tracing, whose noise, {last.image_noise:.2g}, is "
            f"subtracted; {last.name} take {times:.3g} times as long as base"
        )
    return lines


def variants_of(scene: Scene, is_quick: bool) -> dict[str, Scene]:
    """`scene` by name: as it is, then by other settings, one at a time; fewer if it `is_quick`."""

    def vary(section: str, **changes: Any) -> Scene:
        return replace(scene, **{section: replace(getattr(scene, section), **changes)})

    variants = {"base": scene}
    for tolerance in (1e-2, 1e-4, 1e-6) if is_quick else (1e-1, 1e-2, 1e-3, 1e-4, 1e-6):
        variants[f"tolerance {tolerance}"] = vary("diffusion", tolerance=tolerance)
    for closure in CLOSURES:
        variants[f"closure {closure}"] = vary("diffusion", closure=closure)
    variants["rounds by the medium"] = vary("diffusion", transport_rounds=None)
    for rounds, degree in ((0, 3), (1, 3), (2, 3), *(() if is_quick else ((4, 3), (2, 5)))):
        change = vary("diffusion", transport_rounds=rounds, degree=degree)
        variants[f"rounds {rounds}, degree {degree}"] = change
    for steps in (1, 2):
        variants[f"steps {steps}"] = vary("render", steps_per_voxel=steps)
    for tolerance in (0, 0.05) if is_quick else (0, 0.01, 0.05, 1):
        variants[f"pixels {tolerance}"] = vary("render", tolerance=tolerance)
    for factor in (2,) if is_quick else (2, 4):
        coarse = replace(scene_at_level(scene, factor), views=scene.views)
        variants[f"grid {factor} times coarser"] = coarse
    base = _settings(scene)
    return {n: v for n, v in variants.items() if n == "base" or _settings(v) != base}


def _settings(scene: Scene) -> tuple[object, ...]:
    """What is varied; without the degree where there are no rounds that it could matter to."""
    diffusion = scene.diffusion
    if not diffusion.rounds:
        diffusion = replace(diffusion, degree=None)
    return scene.volume.grid.shape, scene.render, diffusion


def exact_scene(scene: Scene) -> Scene:
    """`scene` by the same model on the same grid, solved as exactly as its precision allows, and
    marched in finer steps, ray by ray.
    """
    steps = max(EXACT_STEPS, scene.render.steps)
    diffusion = replace(scene.diffusion, **EXACT)
    settings = replace(scene.render, steps_per_voxel=steps, tolerance=0.0)
    return replace(scene, render=settings, diffusion=diffusion)


def shoot(scene: Scene) -> Shot:
    """An image of the first view of `scene`, rendered from nothing, with its gradient."""
    density = scene.volume.density.detach().clone().requires_grad_()
    varied, memory = with_values(scene, {"density": density}), SolveMemory()
    start = _now(density)
    image = render_each(varied, varied.views[:1], memory)[0]
    middle = _now(density)
    (gradient,) = torch.autograd.grad(image.mean(), density)
    end = _now(density)
    iterations = memory.records[0].iterations if memory.records else 0
    return Shot(image.detach(), gradient, middle - start, end - middle, iterations)


def trace(tracer: Tracer, samples: int, seed: int = 0) -> Shot:
    """An image by so many paths a pixel."""
    start = perf_counter()
    image = torch.from_numpy(tracer.trace(0, seed, samples)).movedim(-1, 0)
    return Shot(image, None, perf_counter() - start, 0.0, samples)


def run_bench(
    scene: Scene, double: Scene, tracer: Tracer | None, is_quick: bool, progress: Progress
) -> list[Row]:
    """A row for every variant of `scene` and for path tracing.

    `double` is `scene` in double precision; without `tracer` there is no path tracing.
    """
    contestants: dict[str, Callable[[], Shot]] = {
        name: partial(shoot, variant) for name, variant in variants_of(scene, is_quick).items()
    }
    exact, solved = (
        dict[str, Shot](),
        dict[tuple[object, ...], Shot](),
    )  # alike ones are solved once
    for name, variant in progress([*variants_of(double, is_quick).items()], "exact solutions"):
        reference = exact_scene(variant)
        key = _settings(replace(reference, render=double.render))
        exact[name] = solved[key] = solved[key] if key in solved else shoot(reference)
    truth = None
    if tracer is not None:
        paths = QUICK_PATHS if is_quick else PATHS
        seeds = range(TRUTH_SEED, TRUTH_SEED + TRUTH_PASSES)
        truth = Traced.of([trace(tracer, paths[-1], seed).image.numpy() for seed in seeds])
        for samples in paths:
            contestants[f"Mitsuba {samples} paths a pixel"] = partial(trace, tracer, samples)
    shots = measure(contestants, 1 if is_quick else TURNS, progress)
    return with_best(
        [row_of(name, series, exact.get(name), truth) for name, series in shots.items()]
    )


def measure(
    contestants: Mapping[str, Callable[[], Shot]], turns: int, progress: Progress
) -> dict[str, list[Shot]]:
    """The shots by name of all `contestants` that can be solved.

    All run once in every turn, so that other work on the machine slows all alike. The first turn,
    in which kernels are compiled, is not counted.
    """
    shots: dict[str, list[Shot]] = {name: [] for name in contestants}
    schedule = [(turn, name) for turn in range(turns + 1) for name in contestants]
    for turn, name in progress(schedule, "bench"):
        if turn == len(shots[name]):
            with suppress(SolveError):
                shots[name].append(contestants[name]())
    return {name: series[1:] for name, series in shots.items() if series}


def row_of(name: str, shots: Sequence[Shot], exact: Shot | None, truth: Traced | None) -> Row:
    """The row of what took these `shots`; times are medians."""
    shot, errors = shots[0], dict[str, Any]()
    if exact is not None and exact.gradient is not None and shot.gradient is not None:
        errors["image_numerical"] = relative_error(shot.image, exact.image)
        errors["gradient_numerical"] = relative_error(shot.gradient, exact.gradient)
    if truth is not None:
        errors["image_error"] = truth.error(shot.image.numpy())
        errors["image_noise"] = truth.noise
    image_seconds = median(shot.image_seconds for shot in shots)
    both_seconds = median(shot.image_seconds + shot.gradient_seconds for shot in shots)
    return Row(name, image_seconds, both_seconds, shot.iterations, **errors)


def describe(rows: Sequence[Row], scene: Scene, environment: dict[str, Any]) -> dict[str, Any]:
    """The bench as plain values."""
    height, width = scene.views[0].camera.size
    has_truth = rows[0].image_error is not None
    return {
        "scene": {"cells": list(reversed(scene.volume.grid.shape)), "pixels": [width, height]},
        "truth_noise": {"image": rows[0].image_noise} if has_truth else None,
        "environment": environment,
        "rows": [asdict(row) for row in rows],
    }


def _now(like: Tensor) -> float:
    """The time, once the device has done what it was given."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return perf_counter()
