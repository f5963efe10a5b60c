"""`ddrecon bench`: time against error of every choice a scene leaves open, and of path tracing.

An image and the gradient of its mean by density are measured; variants take turns. The numerical
error is against the same model solved exactly, in double precision; the whole error is against path
tracing by Mitsuba 3, where that is installed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
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
from ddrecon.reconstruct.setup import scene_at_level
from ddrecon.reference.trace import Traced, Tracer, error_text
from ddrecon.scene import Scene
from ddrecon.validate.hard import plume_scene, relative_error
from ddrecon.variables.values import with_values

TURNS = 2
PATHS, QUICK_PATHS = (4, 16, 64), (4, 16)
"""Paths a pixel that Mitsuba is tried with."""
TRUTH_PASSES, TRUTH_SEED = 4, 1000
"""The truth is the mean of so many images of the most paths, whose seeds begin here."""
QUICK_CELLS = 60_000
"""A quick bench is of a scene made coarser until it has no more cells than this."""
COLUMNS = {"name": "", "image_seconds": ".3f", "both_seconds": ".3f", "times_base": ".2f"}
COLUMNS |= {"iterations": "", "image_numerical": ".1e", "gradient_numerical": ".1e"}
COLUMNS |= {"image_error": ""}


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


def load_pair(
    load: Callable[[torch.dtype], Scene] | None, device: torch.device, is_quick: bool
) -> tuple[Scene, Scene]:
    """The scene that `load` gives, or else the plume, with one view: in float32 and in float64."""

    def load_one(dtype: torch.dtype) -> Scene:
        if load is None:
            cells, pixels = (32, 128) if is_quick else (64, 256)
            return plume_scene(cells, pixels, dtype, device)
        scene, factor = load(dtype), 1
        while is_quick and scene.volume.grid.cells / factor**3 > QUICK_CELLS:
            factor += 1
        return replace(scene_at_level(scene, factor), views=scene.views[:1])

    return load_one(torch.float32), load_one(torch.float64)


def variants_of(scene: Scene, is_quick: bool) -> dict[str, Scene]:
    """`scene` by name: as it is, then by other settings, one at a time; fewer if it `is_quick`."""
    exactness = (1e-2, 1e-4, 1e-6) if is_quick else (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)
    rounds = (0, 3), (1, 3), (2, 3), *(() if is_quick else ((4, 3), (2, 5)))
    changes: dict[str, dict[str, Any]] = {"rounds by the medium": {"transport_rounds": None}}
    changes |= {f"tolerance {tolerance}": {"tolerance": tolerance} for tolerance in exactness}
    changes |= {f"closure {closure}": {"closure": closure} for closure in CLOSURES}
    for count, degree in rounds:
        change = {"transport_rounds": count, "degree": degree}
        changes[f"rounds {count}, degree {degree}"] = change
    of_rays: dict[str, dict[str, Any]] = {f"steps {n}": {"steps_per_voxel": n} for n in (1, 2)}
    for tolerance in (0, 0.05) if is_quick else (0, 0.01, 0.05, 1):
        of_rays[f"pixels {tolerance}"] = {"tolerance": tolerance}
    variants = {
        n: replace(scene, diffusion=replace(scene.diffusion, **changes[n])) for n in changes
    }
    variants |= {n: replace(scene, render=replace(scene.render, **of_rays[n])) for n in of_rays}
    for factor in (2,) if is_quick else (2, 4):
        coarse = replace(scene_at_level(scene, factor), views=scene.views)
        variants[f"grid {factor} times coarser"] = coarse
    base = _settings(scene)
    return {"base": scene} | {n: v for n, v in variants.items() if _settings(v) != base}


def _settings(scene: Scene) -> tuple[object, ...]:
    """What is varied; without the degree where there are no rounds that it could matter to."""
    diffusion = scene.diffusion
    if not diffusion.rounds:
        diffusion = replace(diffusion, degree=None)
    return scene.volume.grid.shape, scene.render, diffusion


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
) -> dict[str, Any]:
    """What every variant of `scene` and path tracing take and miss, as plain values.

    `double` is `scene` in double precision; without `tracer` there is no path tracing. Of the
    `rows`, seconds are medians, `both_seconds` of image and gradient, and errors relative RMS:
    `image_numerical` and `gradient_numerical` against the same model solved exactly, `image_error`
    against path tracing, whose noise, `truth_noise`, is subtracted in quadrature.
    """
    contestants: dict[str, Callable[[], Shot]] = {
        name: partial(shoot, variant) for name, variant in variants_of(scene, is_quick).items()
    }
    exact, solved = dict[str, Shot](), dict[tuple[object, ...], Shot]()
    for name, variant in progress([*variants_of(double, is_quick).items()], "exact solutions"):
        marching = replace(
            variant.render, steps_per_voxel=max(3, variant.render.steps), tolerance=0.0
        )
        diffusion = replace(variant.diffusion, tolerance=1e-8, warm_start=False)
        as_exact = replace(variant, render=marching, diffusion=diffusion)
        key = _settings(replace(as_exact, render=double.render))
        if key not in solved:  # alike ones are solved once
            solved[key] = shoot(as_exact)
        exact[name] = solved[key]
    truth = None
    if tracer is not None:
        paths = QUICK_PATHS if is_quick else PATHS
        seeds = range(TRUTH_SEED, TRUTH_SEED + TRUTH_PASSES)
        truth = Traced.of([trace(tracer, paths[-1], seed).image.numpy() for seed in seeds])
        for samples in paths:
            contestants[f"Mitsuba {samples} paths a pixel"] = partial(trace, tracer, samples)
    shots = measure(contestants, 1 if is_quick else TURNS, progress)
    rows = [row_of(name, series, exact.get(name), truth) for name, series in shots.items()]
    height, width = scene.views[0].camera.size
    return {
        "scene": {"cells": list(reversed(scene.volume.grid.shape)), "pixels": [width, height]},
        "truth_noise": None if truth is None else truth.noise,
        "rows": rows,
    }


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


def row_of(
    name: str, shots: list[Shot], exact: Shot | None, truth: Traced | None
) -> dict[str, Any]:
    """The row of what took these `shots`; errors are None where nothing is to compare with."""
    shot, errors = shots[0], dict.fromkeys(("image_numerical", "gradient_numerical"))
    if exact is not None and exact.gradient is not None and shot.gradient is not None:
        errors["image_numerical"] = relative_error(shot.image, exact.image)
        errors["gradient_numerical"] = relative_error(shot.gradient, exact.gradient)
    return {
        "name": name,
        "image_seconds": median(shot.image_seconds for shot in shots),
        "both_seconds": median(shot.image_seconds + shot.gradient_seconds for shot in shots),
        "iterations": shot.iterations,
        **errors,
        "image_error": None if truth is None else truth.error(shot.image.numpy()),
    }


def bench_lines(report: Mapping[str, Any]) -> list[str]:
    """The report as a Markdown table, and Mitsuba's time; times are multiples of the base's."""
    rows, noise, base = list[dict[str, Any]](), report["truth_noise"], report["rows"][0]
    for row in report["rows"]:
        times = row["both_seconds"] / base["both_seconds"]
        error = None if noise is None else error_text(row["image_error"], noise)
        rows.append(row | {"times_base": times, "image_error": error})
    lines = table_lines(COLUMNS, rows)
    if noise is not None:
        times = rows[-1]["image_seconds"] / base["image_seconds"]
        lines.append(
            f"image error is against path tracing, whose noise, {noise:.2g}, is subtracted; "
            f"{rows[-1]['name']} take {times:.3g} times as long as base"
        )
    return lines


def _now(like: Tensor) -> float:
    """The time, once the device has done what it was given."""
    if like.is_cuda:
        torch.cuda.synchronize(like.device)
    return perf_counter()
