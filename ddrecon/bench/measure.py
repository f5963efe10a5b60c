"""Time and error of each variant's image, and of the gradient of its mean by density.

Variants take turns. The numerical error is against the same model solved exactly, in double
precision; the whole error is against path tracing by Mitsuba 3.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from statistics import median
from time import perf_counter

import torch
from torch import Tensor

from ddrecon.bench.report import Row, with_best
from ddrecon.bench.variants import QUICK, Sweep, exact_scene, model_of, variants_of
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import SolveError
from ddrecon.progress import Progress
from ddrecon.reference.trace import Traced, Tracer
from ddrecon.renderer import render_each
from ddrecon.scene import Scene
from ddrecon.validate.hard import relative_error
from ddrecon.variables.values import with_values

TURNS = 2
PATHS, QUICK_PATHS = (4, 16, 64), (4, 16)
"""Paths a pixel that Mitsuba is tried with.

The truth is the mean of `TRUTH_PASSES` of the most, by other paths, whose seeds begin at
`TRUTH_SEED`.
"""
TRUTH_PASSES, TRUTH_SEED = 4, 1000


@dataclass(frozen=True)
class Shot:
    """One image [3, h, w] of a scene's first view, and the `gradient` [z, y, x] of its mean.

    `gradient` is by density; None of path tracing. `iterations` are the first solve's, or samples a
    pixel.
    """

    image: Tensor
    gradient: Tensor | None
    image_seconds: float
    gradient_seconds: float
    iterations: int


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
    variants = variants_of(scene, QUICK if is_quick else Sweep())
    exact = dict[str, Shot]()  # alike models are solved once
    solved = dict[tuple[object, ...], Shot]()
    for variant in progress(variants, "exact solutions"):
        changed = variant.change(double)
        if (model := model_of(changed)) not in solved:
            solved[model] = shoot(exact_scene(changed))
        exact[variant.name] = solved[model]
    contestants: dict[str, Callable[[], Shot]] = {
        variant.name: functools.partial(shoot, variant.change(scene)) for variant in variants
    }
    truth = None
    if tracer is not None:
        paths = QUICK_PATHS if is_quick else PATHS
        seeds = range(TRUTH_SEED, TRUTH_SEED + TRUTH_PASSES)
        truth = Traced.of([trace(tracer, paths[-1], seed).image.numpy() for seed in seeds])
        contestants |= {
            f"Mitsuba {samples} paths a pixel": functools.partial(trace, tracer, samples)
            for samples in paths
        }
    shots = measure(contestants, 1 if is_quick else TURNS, progress)
    return with_best([row_of(name, each, exact.get(name), truth) for name, each in shots.items()])


def measure(
    contestants: Mapping[str, Callable[[], Shot]], turns: int, progress: Progress
) -> dict[str, list[Shot]]:
    """The shots by name of all `contestants` that can be solved.

    Each runs once in every turn, so that what else runs slows all alike. One is run once before,
    uncounted: the first work of a process takes longer.
    """
    shots: dict[str, list[Shot]] = {name: [] for name in contestants}
    with suppress(SolveError):
        next(iter(contestants.values()))()
    for turn, name in progress(
        [(turn, name) for turn in range(turns) for name in contestants], "bench"
    ):
        if turn == len(shots[name]):
            with suppress(SolveError):
                shots[name].append(contestants[name]())
    return {name: each for name, each in shots.items() if each}


def row_of(name: str, shots: Sequence[Shot], exact: Shot | None, truth: Traced | None) -> Row:
    """The row of what took these `shots`; times are medians."""
    shot = shots[0]
    row = Row(
        name,
        median(each.image_seconds for each in shots),
        median(each.image_seconds + each.gradient_seconds for each in shots),
        shot.iterations,
    )
    if exact is not None and exact.gradient is not None and shot.gradient is not None:
        row = replace(
            row,
            image_numerical=relative_error(shot.image, exact.image),
            gradient_numerical=relative_error(shot.gradient, exact.gradient),
        )
    if truth is not None:
        error = truth.error(shot.image.numpy())
        row = replace(row, image_error=error, image_noise=truth.noise)
    return row


def _now(like: Tensor) -> float:
    """The time, once the device has done what it was given."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return perf_counter()
