"""What `ddrecon check` reports of a scene."""

from __future__ import annotations

from typing import Any

from ddrecon.engine import name_engines
from ddrecon.memory import gibibytes, memory_of, needs_of
from ddrecon.reconstruct.setup import select_views
from ddrecon.reconstruct.support import describe_support, find_support, support_text
from ddrecon.run.quality import describe_loss, loss_text
from ddrecon.scene import Scene, View
from ddrecon.scene_file.doubts import find_doubts
from ddrecon.terms import engine_of_scene, needed_terms
from ddrecon.variables.values import with_values


def memory_estimate(scene: Scene) -> int:
    """Bytes that rendering all views of `scene` takes at its peak, without torch itself.

    Derivatives are counted where the scene is to be optimized.
    """
    volume, grid = scene.volume, scene.volume.grid
    fields = [start for start in scene.starts.values() if tuple(start.shape[-3:]) == grid.shape]
    needs = needs_of(
        grid,
        volume.phase,
        max(volume.sigma_a.shape[0], volume.sigma_s.shape[0]),
        volume.density,
        scene.diffusion,
        pixels=sum(view.camera.size[0] * view.camera.size[1] for view in scene.views),
        lights=len(scene.lights),
        optimized=scene.starts,
        varied=sum(field.numel() for field in fields) / grid.cells,
    )
    return memory_of(needs)


def describe(scene: Scene, expert: dict[str, Any], has_slabs: bool = False) -> dict[str, Any]:
    """What `ddrecon check` reports of `scene`: grid, views, physics, parameters, engine, memory.

    And what can hardly be meant. Its parameters are where they start. `expert`: keys for experts
    that are not at their default; `has_slabs`: ranks are to share out its cells.
    """
    scene = with_values(scene, scene.starts)
    grid = scene.volume.grid
    low, high = grid.bounds_xyz
    parameters = scene.optimize.parameters if scene.optimize else {}
    return {
        "resolution": list(reversed(grid.shape)),
        "bounds": [list(low), list(high)],
        "voxel": list(reversed(grid.spacing)),
        "views": [_describe_view(view) for view in scene.views],
        "physics": needed_terms(scene),
        "optimizes": {name: scene.starts[name].numel() for name in parameters},
        "loss": _describe_loss(scene),
        "support": _describe_support(scene),
        "engine": engine_of_scene(scene, has_slabs),
        "expert_keys": expert,
        "memory_bytes": memory_estimate(scene),
        "doubts": find_doubts(scene),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """The report of `describe` as lines of text."""
    low, high = report["bounds"]
    sizes = f"{_by(report['resolution'])} cells of {_by(report['voxel'])} u"
    parameters = [_count_entries(*item) for item in report["optimizes"].items()]
    return [
        f"grid: {sizes}, from {low} to {high}",
        f"views: {len(report['views'])}",
        *(f"  {_view_line(view)}" for view in report["views"]),
        "physics:",
        *(f"  {term}" for term in report["physics"]),
        f"optimizes: {', '.join(parameters) or 'nothing'}",
        *([loss_text(report["loss"])] if report["loss"] else []),
        *([support_text(report["support"])] if report["support"] else []),
        *([f"for experts: {_pairs(report['expert_keys'])}"] if report["expert_keys"] else []),
        f"engine: {name_engines(report['engine'])}",
        f"memory: about {gibibytes(report['memory_bytes'])} at the peak, besides torch itself",
    ]


def _describe_loss(scene: Scene) -> dict[str, Any] | None:
    """What is minimized, and what is compared; None where nothing is."""
    train = select_views(scene, is_test=False)
    return describe_loss(scene.optimize, train) if scene.optimize and train.views else None


def _describe_support(scene: Scene) -> dict[str, float] | None:
    """Which part of the cells density may be in; None where that is all of them."""
    if scene.optimize is None:
        return None
    train = select_views(scene, is_test=False)
    support = find_support(train, scene.optimize)
    return describe_support(support, scene.volume.grid)


def _view_line(view: dict[str, Any]) -> str:
    size = f"{view['width']} x {view['height']} pixels"
    image = ", with image" if view["has_image"] else ""
    return f"{view['name']}: {view['camera']}, {size}, {view['split']}{image}"


def _count_entries(name: str, count: int) -> str:
    return f"{name} ({count:,} number{'s' if count > 1 else ''})"


def _pairs(values: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items())


def _by(sizes: list[float]) -> str:
    return " x ".join(f"{size:.4g}" for size in sizes)


def _describe_view(view: View) -> dict[str, Any]:
    height, width = view.camera.size
    return {
        "name": view.name,
        "camera": "perspective" if view.camera.is_perspective else "orthographic",
        "width": width,
        "height": height,
        "split": "test" if view.is_test else "train",
        "has_image": view.image is not None,
    }
