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
from ddrecon.bench.plot import draw
from ddrecon.bench.plume import plume_scene
from ddrecon.bench.report import Row, rows_of, table
from ddrecon.bench.variants import QUICK, Sweep, variants_of
from ddrecon.io.json_file import write_json
from ddrecon.reconstruct.levels import at_level
from ddrecon.session import Session
from ddrecon.validate import hard
from ddrecon.world import Scene

TURNS = 3
QUICK_CELLS = 60_000
"""A quick bench is of a scene made coarser until it has no more cells than this."""


def bench_speed(session: Session, path: Path | None, is_quick: bool, output: Path | None, report: Path | None) -> bool:
    """Measures the scene at `path`, or the plume; prints the table, writes what was asked for, and has passed."""
    scene, double = (_scene(session, path, dtype, is_quick) for dtype in (torch.float32, torch.float64))
    rows = run_bench(scene, double, is_quick, session.progress)
    found = describe(rows, scene, session.environment())
    click.echo("\n".join(table(rows)))
    if output is not None:
        write_json(output / "bench.json", found)
        click.echo(_drawn(rows, output))
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
        return plume_scene(*((32, 128) if is_quick else (64, 512)), dtype, session.device)
    scene = replace(session, dtype=dtype).load(path)
    return quick(scene) if is_quick else scene


def quick(scene: Scene) -> Scene:
    """`scene` with so few cells, and as many fewer pixels, that its bench is quick."""
    factor = 1
    while scene.volume.grid.cells / factor**3 > QUICK_CELLS:
        factor += 1
    return at_level(scene, factor)


def run_bench(scene: Scene, double: Scene, is_quick: bool, progress: Progress) -> list[Row]:
    """A row for every variant of `scene` (its first view); `double` is the same scene in double precision."""
    scene, double = (replace(item, views=item.views[:1]) for item in (scene, double))
    variants = variants_of(scene, QUICK if is_quick else Sweep())
    exact = exact_shots(variants, double, progress)
    ours = {variant.name: functools.partial(shoot, variant.change(scene), blocks_of(scene)) for variant in variants}
    timings = measure(ours, 1 if is_quick else TURNS, progress)
    return rows_of(variants, timings, exact, None)


def _drawn(rows: Sequence[Row], folder: Path) -> str:
    """Draws bench.png into `folder` where matplotlib is installed; what to tell the user."""
    try:
        draw(rows, folder / "bench.png")
    except ModuleNotFoundError:
        return f'written to {folder}; no plot, which needs matplotlib: pip install "ddrecon[plot]"'
    return f"written to {folder}"


def describe(rows: Sequence[Row], scene: Scene, environment: dict[str, Any]) -> dict[str, Any]:
    """The bench as plain values."""
    height, width = scene.views[0].camera.size
    size = {"cells": list(reversed(scene.volume.grid.shape)), "pixels": [width, height]}
    return {"scene": size, "environment": environment, "variants": [asdict(row) for row in rows]}
