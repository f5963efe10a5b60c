"""What `ddrecon check` reports of a scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from typing import Any

from ddrecon.cameras import CELL, cell_width
from ddrecon.engine import current_engine
from ddrecon.errors import DdreconError, SceneError
from ddrecon.io.info import sizes_text
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
from ddrecon.run.quality import describe_loss, loss_text
from ddrecon.scene import Scene, View
from ddrecon.scene_file.build import needs_of_scene
from ddrecon.scene_file.doubts import find_doubts
from ddrecon.settings import AUTO
from ddrecon.terms import needed_terms
from ddrecon.turntable import upright_axis
from ddrecon.variables.values import with_values

TOO_WIDE = 8.0
"""Cells that are at least so many pixels wide to all views are told."""


def memory_estimate(scene: Scene) -> int:
    """Bytes that rendering all views of `scene` takes at its peak, without torch itself.

    Derivatives are counted where the scene is to be optimized.
    """
    media = scene.volume.media or {"": scene.volume}
    return needs_of_scene(media, scene.views, scene.diffusion, scene.optimize).total


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


def asks_support(scene: Scene) -> bool:
    """Whether `scene` asks for a support of its density."""
    density = scene.optimize.parameters.get("density") if scene.optimize else None
    return density is not None and density.support is not None


def describe(scene: Scene, supports: Sequence[Support] = (), up: str = "y") -> dict[str, Any]:
    """What `ddrecon check` reports of `scene`: its grid, physics, engine, time and so on.

    And what can hardly be meant. Its parameters are where they start. `up` is `volume.up`.
    """
    built, scene = scene, with_values(scene, scene.starts)
    grid, train = scene.volume.grid, select_views(scene, is_test=False)
    low, high = grid.bounds_xyz
    loss, seconds = None, None
    if scene.optimize is not None and train.views:
        loss = describe_loss(scene.optimize, train)
        with suppress(DdreconError):  # what is wrong is told by a run
            seconds = time_iteration(built)
    support = None
    with suppress(SceneError) if not asks_support(scene) else nullcontext():
        upright = upright_axis(replace(scene, up=None)), "xyz".index(up)
        support = describe_support(supports, grid, upright)
        if support is not None and "doubt" not in support:
            support["cut"] = find_cut(supports[0], grid)
    return {
        "resolution": list(reversed(grid.shape)),
        "bounds": [list(low), list(high)],
        "voxel": list(reversed(grid.spacing)),
        "views": [
            {
                "name": view.name,
                "camera": "perspective" if view.camera.is_perspective else "orthographic",
                "width": view.camera.size[1],
                "height": view.camera.size[0],
                "split": "test" if view.is_test else "train",
                "has_image": view.image is not None,
                "cell": cell_width(grid, view.camera),
            }
            for view in scene.views
        ],
        "physics": needed_terms(scene),
        "optimizes": {name: start.numel() for name, start in scene.starts.items()},
        "loss": loss,
        "support": support,
        "engine": current_engine(),
        "memory_bytes": memory_estimate(scene),
        "iteration_seconds": seconds,
        "iterations": scene.optimize and scene.optimize.iterations,
        "doubts": find_doubts(scene),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """The report of `describe` as lines of text."""
    low, high = report["bounds"]
    sizes = f"{sizes_text(report['resolution'])} cells of {sizes_text(report['voxel'])} u"
    parameters = [
        f"{name} ({count:,} number{'s' if count > 1 else ''})"
        for name, count in report["optimizes"].items()
    ]
    views = [
        f"  {view['name']}: {view['camera']}, {view['width']} x {view['height']} pixels,"
        f" {view['split']}{', with image' if view['has_image'] else ''}"
        for view in report["views"]
    ]
    widths = [view["cell"] for view in report["views"]]
    return [
        f"grid: {sizes}, from {low} to {high}",
        f"views: {len(report['views'])}",
        *views,
        f"cells: {min(widths):.2g} to {max(widths):.2g} pixels wide{_advise_on_cells(min(widths))}",
        "physics:",
        *(f"  {term}" for term in report["physics"]),
        f"optimizes: {', '.join(parameters) or 'nothing'}",
        *([loss_text(report["loss"])] if report["loss"] else []),
        *([support_text(report["support"])] if report["support"] else []),
        f"engine: {report['engine']}",
        f"memory: about {gibibytes(report['memory_bytes'])} at the peak, besides torch itself",
        *([_time_text(report)] if report["iteration_seconds"] else []),
    ]


def _time_text(report: dict[str, Any]) -> str:
    """How long iterations take, and as many as were asked for, or a hundred of a run by itself."""
    seconds, count = report["iteration_seconds"], report["iterations"]
    count = 100 if count == AUTO else count
    whole = f"at most {count * seconds / 60:.2g} minutes for {count}"
    return f"time: about {seconds:.2g} s an iteration at full resolution, {whole}"


def _advise_on_cells(width: float) -> str:
    """What to change where all views see cells at least so many pixels wide."""
    if width < TOO_WIDE:
        return ""
    return (
        f", which show less than the pictures: a run averages {int(width / CELL)} x"
        f" {int(width / CELL)} pixels; smaller cells (volume.resolution: auto) show more"
    )
