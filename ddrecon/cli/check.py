"""What `ddrecon check` tells of a scene."""

import math
from collections.abc import Iterable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from typing import Any

from ddrecon.cameras import CELL, cell_width
from ddrecon.engine import current_engine
from ddrecon.errors import DdreconError, SceneError
from ddrecon.io.info import box_text, sizes_text
from ddrecon.memory import gibibytes
from ddrecon.reconstruct.loop import time_iteration
from ddrecon.reconstruct.setup import select_views
from ddrecon.reconstruct.support import (
    Support,
    describe_support,
    find_cut,
    find_support,
    support_text,
)
from ddrecon.run.job import Outcome
from ddrecon.run.quality import describe_loss, loss_text
from ddrecon.scene import Scene, View
from ddrecon.scene_file.build import needs_of_scene
from ddrecon.settings import AUTO
from ddrecon.terms import find_doubts, needed_terms, thick_terms
from ddrecon.variables.values import with_values

TOO_WIDE = 8.0
"""Cells that are at least so many pixels wide to all views are told."""


def supports_of(frames: Iterable[Scene]) -> list[Support]:
    """Where density may be in each of `frames`, of one scene or of a film, by their pictures.

    Where it has no support it is as by `support: auto`, if pictures tell.
    """
    supports = list[Support]()
    for scene in frames:
        train, settings = select_views(scene, is_test=False), scene.optimize
        density = settings.parameters.get("density") if settings is not None else None
        if settings is not None and density is not None and train.views:
            auto = replace(density, support=density.support or AUTO)
            with nullcontext() if density.support else suppress(SceneError):
                support = find_support(train, replace(settings, parameters={"density": auto}))
                if support is not None and supports:
                    # A film keeps the pictures of its first frame: all take too much memory.
                    views = [View(view.name, view.camera) for view in support.views]
                    support = replace(support, views=views)
                supports += [] if support is None else [support]
    return supports


def describe(scene: Scene, supports: Sequence[Support] = ()) -> Outcome:
    """Tells of `scene` its grid, physics, engine, time and so on, and what can hardly be meant.

    Its parameters are where they start.
    """
    built, scene = scene, with_values(scene, scene.starts)
    grid, train, settings = scene.volume.grid, select_views(scene, is_test=False), scene.optimize
    loss, seconds, support = None, None, None
    if settings is not None and train.views:
        loss = describe_loss(settings, train)
        with suppress(DdreconError):  # what is wrong is told by a run
            seconds = time_iteration(built)
    density = settings.parameters.get("density") if settings is not None else None
    is_asked = density is not None and density.support is not None
    with nullcontext() if is_asked else suppress(SceneError):
        support = describe_support(supports, grid)
        if support is not None and "doubt" not in support:
            support["cut"] = find_cut(supports[0], grid)
    bounds, cells = list(map(list, grid.bounds_xyz)), list(reversed(grid.shape))
    media = scene.volume.media or {"": scene.volume}
    lines = [f"grid: {sizes_text(cells)} cells of {box_text(cells, bounds)}"]
    views, texts = _describe_views(scene)
    lines += [f"views: {len(views)}", *texts]
    widths = [view["cell"] for view in views]
    report: dict[str, Any] = {
        "resolution": cells,
        "bounds": bounds,
        "voxel": list(reversed(grid.spacing)),
        "views": views,
        "physics": [*needed_terms(scene), *thick_terms(scene)],
        "optimizes": {name: start.numel() for name, start in scene.starts.items()},
        "loss": loss,
        "support": support,
        "engine": current_engine(),
        "memory_bytes": needs_of_scene(media, scene.views, scene.diffusion, settings).total,
        "iteration_seconds": seconds,
        "iterations": settings and settings.iterations,
        "doubts": find_doubts(scene),
    }
    least, most = min(widths), max(widths)
    lines.append(f"cells: {least:.3g} to {most:.3g} pixels wide{_advise_on_cells(least)}")
    lines += ["physics:", *(f"  {term}" for term in report["physics"])]
    counts = report["optimizes"].items()
    sought = [f"{name} ({count:,} number{'s' if count > 1 else ''})" for name, count in counts]
    lines.append(f"optimizes: {', '.join(sought) or 'nothing'}")
    lines += [loss_text(loss)] if loss else []
    lines += [support_text(support)] if support and "cells" in support else []
    memory = gibibytes(report["memory_bytes"])
    lines.append(f"engine: {report['engine']}")
    lines.append(f"memory: about {memory} at the peak, besides torch itself")
    if seconds and settings is not None:
        # A run that ends by itself makes about a hundred.
        count = 100 if settings.iterations == AUTO else settings.iterations
        whole = f"at most {math.ceil(count * seconds / 60)} minutes for {count}"
        lines.append(f"time: about {seconds:.3g} s an iteration at full resolution, {whole}")
    return report, lines


def _describe_views(scene: Scene) -> tuple[list[dict[str, Any]], list[str]]:
    """What is told of each view, and a line of it."""
    views, lines = list[dict[str, Any]](), list[str]()
    for view in scene.views:
        camera = view.camera
        row = {
            "name": view.name,
            "camera": "perspective" if camera.is_perspective else "orthographic",
            "width": camera.size[1],
            "height": camera.size[0],
            "split": "test" if view.is_test else "train",
            "has_image": view.image is not None,
            "cell": cell_width(scene.volume.grid, camera),
        }
        views.append(row)
        text = "  {name}: {camera}, {width} x {height} pixels, {split}".format(**row)
        lines.append(text + (", with image" if row["has_image"] else ""))
    return views, lines


def _advise_on_cells(width: float) -> str:
    """What to change where all views see cells at least so many pixels wide."""
    if width < TOO_WIDE:
        return ""
    return (
        f", which show less than the pictures: a run averages {int(width / CELL)} x"
        f" {int(width / CELL)} pixels; smaller cells (volume.resolution: auto) show more"
    )
