"""A bench from beginning to end: what is measured, in which order, and what is written."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click
import torch

from ddrecon.bench.measure import Progress, blocks_of, exact_shots, measure, shoot
from ddrecon.bench.path_tracing import PathTracer, Truth
from ddrecon.bench.plot import draw
from ddrecon.bench.plume import plume_scene
from ddrecon.bench.report import Row, rows_of, table, write_bench_report
from ddrecon.bench.variants import QUICK, Sweep, variants_of
from ddrecon.cli.session import Session
from ddrecon.errors import MissingExtraError, SceneError
from ddrecon.io.files.json_file import write_json
from ddrecon.reconstruct.levels import scene_at_level
from ddrecon.scene import Scene
from ddrecon.validate import hard

TURNS = 2
PATHS, QUICK_PATHS = (4, 16, 64), (4, 16)
"""Paths a pixel that Mitsuba is tried with; the truth is the mean of `TRUTH_PASSES` of the most, by
other paths.
"""
TRUTH_PASSES = 4
QUICK_CELLS = 60_000
"""A quick bench is of a scene made coarser until it has no more cells than this."""


def bench_speed(
    session: Session, path: Path | None, is_quick: bool, output: Path | None, report: Path | None
) -> bool:
    """Measures the scene at `path`, or the plume; prints the table, writes what was asked for, and
    has passed.
    """
    scene, double = (
        _scene(session, path, dtype, is_quick) for dtype in (torch.float32, torch.float64)
    )
    scene, double = (replace(item, views=item.views[:1]) for item in (scene, double))
    tracer = _tracer(scene, has_gradient=not is_quick)
    rows, truth = run_bench(scene, double, tracer, is_quick, session.progress)
    found = describe(rows, truth, scene, session.environment())
    remarks = against_path_tracing(rows)
    click.echo("\n".join([*table(rows), *remarks]))
    if output is not None:
        write_json(output / "bench.json", found)
        click.echo(_draw(rows, output))
        plot = output / "bench.png"
        write_bench_report(
            output / "report.html",
            rows,
            remarks,
            plot.read_bytes() if plot.is_file() else None,
            session.environment(),
        )
    if report is not None:
        write_json(report, found)
    return True


def bench_hard(session: Session, output: Path | None, report: Path | None) -> bool:
    """Runs the hard cases, prints and writes their table, and says whether all have passed."""
    results = hard.run_cases(session.device, session.progress)
    click.echo("\n".join(hard.table(results)))
    for file in (output / "hard.json" if output else None, report):
        if file is not None:
            write_json(file, hard.describe(results))
    return not any(result.failures() for result in results)


def _scene(session: Session, path: Path | None, dtype: torch.dtype, is_quick: bool) -> Scene:
    if path is None:
        return plume_scene(*((32, 128) if is_quick else (64, 256)), dtype, session.device)
    scene = replace(session, dtype=dtype).load(path)
    return quick(scene) if is_quick else scene


def quick(scene: Scene) -> Scene:
    """`scene` with so few cells, and as many fewer pixels, that its bench is quick."""
    factor = 1
    while scene.volume.grid.cells / factor**3 > QUICK_CELLS:
        factor += 1
    return scene_at_level(scene, factor)


def run_bench(
    scene: Scene, double: Scene, tracer: PathTracer | None, is_quick: bool, progress: Progress
) -> tuple[list[Row], Truth | None]:
    """A row for every variant of `scene` and for path tracing, and the truth; `double` is `scene`
    in double precision.
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


def against_path_tracing(rows: Sequence[Row]) -> list[str]:
    """How long path tracing takes to the error of the base, since its own falls with the square
    root of time; none without it.
    """
    base, traced = (
        rows[0],
        [row for row in rows if row.name.startswith("Mitsuba") and row.image_error],
    )
    if not traced or not base.image_error:
        return []
    last = traced[-1]
    seconds = last.image_seconds * ((last.image_error or 0.0) / base.image_error) ** 2
    times = seconds / base.image_seconds
    lines = [
        f"Mitsuba reaches base's image error, {base.image_error:.3f}, in {seconds:.1f} s: {times:.0f} times its time"
    ]
    if last.gradient_correlation is not None:
        ratio = last.both_seconds / base.both_seconds
        lines.append(
            f"image and gradient take {last.name} {ratio:.0f} times as long as base; gradients correlate with the truth's by "
            f"{last.gradient_correlation:.3f} and {base.gradient_correlation or 0.0:.3f}"
        )
    return lines


def _draw(rows: Sequence[Row], folder: Path) -> str:
    """Draws bench.png into `folder` where matplotlib is installed; what to tell the user."""
    try:
        draw(rows, folder / "bench.png")
    except MissingExtraError as error:
        return f"written to {folder}, without a plot: {error}"
    return f"written to {folder}"


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


def _tracer(scene: Scene, has_gradient: bool) -> PathTracer | None:
    """Mitsuba, where it is installed and can show the scene."""
    try:
        return PathTracer(scene, has_gradient)
    except (MissingExtraError, SceneError) as error:
        click.echo(f"without path tracing: {error}", err=True)
        return None
