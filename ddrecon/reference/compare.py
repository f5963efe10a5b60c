"""Our images beside path-traced ones as files, and how far apart they are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.io.images.table import write_picture, write_preview
from ddrecon.lighting import solve_light
from ddrecon.losses import Target
from ddrecon.picture import view_image
from ddrecon.progress import Progress
from ddrecon.reference.mitsuba_scene import LONGEST
from ddrecon.reference.trace import Traced, Tracer, error_text
from ddrecon.report.pictures import comparison, diverging, pixels
from ddrecon.scene import Scene, View

PASSES = 8
"""Passes an image is traced in, whose scatter says how noisy it is; no more than paths a pixel."""
SEEDS = 2**30
"""Seeds that Mitsuba takes."""


def compare_to_folder(
    tracer: Tracer,
    scene: Scene | None,
    views: Sequence[View],
    folder: Path,
    samples: int,
    seed: int,
    progress: Progress,
) -> dict[str, Any]:
    """Writes traced and our own images of `views` of `scene`, and returns a report with our errors.

    They are NAME.reference.*, NAME.ours.*, NAME.difference.* (ours less the reference) and
    NAME.comparison.png in `folder`; without `scene` the traced ones alone, NAME.*. `tracer` must be
    of these views, and each is traced with `samples` >= 2 paths a pixel; `progress` is told of the
    passes of each view.
    """
    passes = min(PASSES, samples)
    samples_per_pass = -(-samples // passes)
    settings = {
        "samples_per_pixel": passes * samples_per_pass,
        "passes": passes,
        "seed": seed,
        "variant": tracer.module.variant(),
        "integrator": "volpath",
        "longest_path": LONGEST,
        "russian_roulette": False,
        "colors_traced_apart": len(tracer.scenes) > 1,
    }
    report: dict[str, Any] = {"settings": settings, "views": {}, "files": {}}
    if scene is not None:
        start = perf_counter()
        with torch.no_grad():
            light_field = solve_light(scene, SolveMemory())
        report["seconds"] = {"light": perf_counter() - start}
    for index, view in enumerate(views):
        start = perf_counter()
        images = [
            tracer.trace(index, (seed * passes + number) % SEEDS, samples_per_pass)
            for number in progress(range(passes), view.name)
        ]
        traced = Traced.of(images)
        seconds = {"reference": perf_counter() - start}
        measured: dict[str, Any] = {"noise": traced.noise, "seconds": seconds}
        if scene is None:
            written = write_picture(folder / view.name, traced.image)
        else:
            start = perf_counter()
            with torch.no_grad():
                ours = view_image(light_field, scene, view.camera).cpu()
            seconds["ours"] = perf_counter() - start
            theirs = torch.from_numpy(traced.image).permute(2, 0, 1).to(ours)
            measured |= _measure(traced, ours, theirs)
            written = _write(folder / view.name, ours, theirs)
        report["views"][view.name] = measured
        report["files"][view.name] = [path.name for path in written]
    return report


def _measure(traced: Traced, ours: Tensor, theirs: Tensor) -> dict[str, Any]:
    """How far `ours` [3, h, w] is from what was traced; `theirs` is the same image as a tensor."""
    image, mean = pixels(ours).astype(np.float64), float(traced.image.mean())
    return {
        "error": traced.error(image),
        "distance": traced.distance(image),
        "psnr": float(Target.of(theirs, None).psnr_of(ours)),
        "brightness": float(image.mean()) / mean if mean > 0 else None,
    }


def _write(stem: Path, ours: Tensor, theirs: Tensor) -> list[Path]:
    difference = ours - theirs
    pictures: dict[str, tuple[np.ndarray, np.ndarray | None]] = {
        "reference": (pixels(theirs), None),
        "ours": (pixels(ours), None),
        "difference": (pixels(difference), diverging(difference)[0]),
    }
    beside = stem.with_name(f"{stem.name}.comparison.png")
    write_preview(beside, comparison(theirs, ours))
    written = [
        path
        for kind, (array, preview) in pictures.items()
        for path in write_picture(Path(f"{stem}.{kind}"), array, preview)
    ]
    return [*written, beside]


def reference_lines(report: dict[str, Any]) -> list[str]:
    """How far ours is from theirs, and how long both took, as `reference` prints it."""
    lines = []
    for name, view in report["views"].items():
        noise, notes = view["noise"], [f"noise {view['noise']:.3f}"]
        if "error" in view:
            distance = f"with the reference's noise, {noise:.3f}: {view['distance']:.3f}"
            error = f"relative RMS error {error_text(view['error'], noise)} ({distance})"
            notes = [error, f"PSNR {view['psnr']:.1f} dB"]
            if view["brightness"] is not None:
                notes.append(f"brightness {view['brightness']:.3f} of the reference's")
        times = ", ".join(f"{who} {seconds:.2f} s" for who, seconds in view["seconds"].items())
        lines.append(f"{name}: {', '.join(notes)} ({times})")
    samples, mitsuba = report["settings"]["samples_per_pixel"], report["environment"]["mitsuba"]
    return [*lines, f"{samples} paths a pixel, Mitsuba {mitsuba}"]
