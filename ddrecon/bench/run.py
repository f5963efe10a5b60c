"""A bench from beginning to end: what is measured, in which order, and what is written."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from ddrecon.bench.measure import blocks_of, exact_shots, measure, shoot
from ddrecon.bench.path_tracing import PathTracer, Truth
from ddrecon.bench.plot import draw
from ddrecon.bench.plume import plume_scene
from ddrecon.bench.report import Row, rows_of, table, write_bench_report
from ddrecon.bench.variants import QUICK, Sweep, variants_of
from ddrecon.errors import MissingExtraError
from ddrecon.io.files.json_file import write_json
from ddrecon.progress import Progress
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.scene import Scene

TURNS = 2
PATHS, QUICK_PATHS = (4, 16, 64), (4, 16)
"""Paths a pixel that Mitsuba is tried with.

The truth is the mean of `TRUTH_PASSES` of the most, by other paths.
"""
TRUTH_PASSES = 4
QUICK_CELLS = 60_000
"""A quick bench is of a scene made coarser until it has no more cells than this."""


def load_pair(
    load: Callable[[torch.dtype], Scene] | None, device: torch.device, is_quick: bool
) -> tuple[Scene, Scene]:
    """The scene that `load` gives, or else the plume, with one view: in float32 and in float64."""
    pair = []
    for dtype in (torch.float32, torch.float64):
        if load is None:
            cells, pixels = (32, 128) if is_quick else (64, 256)
            scene = plume_scene(cells, pixels, dtype, device)
        else:
            scene = coarsen(load(dtype)) if is_quick else load(dtype)
        pair.append(replace(scene, views=scene.views[:1]))
    return pair[0], pair[1]


def coarsen(scene: Scene) -> Scene:
    """`scene` with so few cells, and as many fewer pixels, that its bench is quick."""
    factor = 1
    while scene.volume.grid.cells / factor**3 > QUICK_CELLS:
        factor += 1
    return scene_at_level(scene, factor)


def run_bench(
    scene: Scene, double: Scene, tracer: PathTracer | None, is_quick: bool, progress: Progress
) -> tuple[list[Row], Truth | None]:
    """A row for every variant of `scene` and for path tracing, and the truth.

    `double` is `scene` in double precision; without `tracer` there is no truth.
    """
    variants = variants_of(scene, QUICK if is_quick else Sweep())
    exact = exact_shots(variants, double, progress)
    contestants = {
        variant.name: functools.partial(shoot, variant.change(scene), blocks_of(scene))
        for variant in variants
    }
    paths = QUICK_PATHS if is_quick else PATHS
    truth = tracer.truth(paths[-1], TRUTH_PASSES) if tracer is not None else None
    if tracer is not None:
        contestants |= {
            f"Mitsuba {samples} paths a pixel": functools.partial(tracer.shoot, samples)
            for samples in paths
        }
    return rows_of(measure(contestants, 1 if is_quick else TURNS, progress), exact, truth), truth


def bench_lines(rows: Sequence[Row]) -> list[str]:
    """The table of `rows`, and what path tracing tells, as lines."""
    return [*table(rows), *against_path_tracing(rows)]


def against_path_tracing(rows: Sequence[Row]) -> list[str]:
    """What the truth can tell, and how path tracing compares, in words; nothing without it."""
    base, last = rows[0], rows[-1]
    if last.image_error is None:
        return []
    lines = [
        f"image error is against {TRUTH_PASSES * last.iterations} paths a pixel, whose noise, "
        f"{last.image_noise:.2g}, is subtracted; {last.name} take "
        f"{last.image_seconds / base.image_seconds:.3g} times as long as base"
    ]
    if last.gradient_correlation is not None:
        ratio = last.both_seconds / base.both_seconds
        theirs, ours = last.gradient_correlation, base.gradient_correlation or 0.0
        lines.append(
            f"image and gradient take {last.name} {ratio:.0f} times as long as base; "
            f"gradients correlate with the truth's by {theirs:.3f} and {ours:.3f}"
        )
    return lines


def describe(
    rows: Sequence[Row], truth: Truth | None, scene: Scene, environment: dict[str, Any]
) -> dict[str, Any]:
    """The bench as plain values."""
    height, width = scene.views[0].camera.size
    size = {"cells": list(reversed(scene.volume.grid.shape)), "pixels": [width, height]}
    noise = None
    if truth is not None:
        noise = {
            "image": truth.image.noise,
            "gradient": truth.by_amount.noise if truth.by_amount is not None else None,
        }
    return {
        "scene": size,
        "truth_noise": noise,
        "environment": environment,
        "rows": [asdict(row) for row in rows],
    }


def write_bench(folder: Path, rows: Sequence[Row], report: dict[str, Any]) -> str:
    """Where bench.json, report.html and, with matplotlib, bench.png were written, in words.

    `report` is what `describe` gives of the `rows`.
    """
    write_json(folder / "bench.json", report)
    plot, notice = folder / "bench.png", f"written to {folder}"
    try:
        draw(rows, plot)
    except MissingExtraError as error:
        notice = f"{notice}, without a plot: {error}"
    png = plot.read_bytes() if plot.is_file() else None
    remarks = against_path_tracing(rows)
    write_bench_report(folder / "report.html", rows, remarks, png, report["environment"])
    return notice
