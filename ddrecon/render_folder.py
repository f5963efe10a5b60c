"""Rendered views as files: linear pixels, previews, and a report of what it took."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.io.images import write_linear, write_preview
from ddrecon.io.json_file import write_json
from ddrecon.reconstruct.losses import psnr
from ddrecon.reconstruct.previews import pixels
from ddrecon.renderer import LightField, solve_light, view_components, view_image
from ddrecon.terms import needed_terms
from ddrecon.world import Scene, View


def render_to_folder(
    scene: Scene, views: list[View], folder: Path, has_components: bool, progress: Callable[[list[View], str], Iterable[View]]
) -> dict[str, Any]:
    """Renders `views` of `scene` into `folder` and returns the report that `render.json` holds."""
    memory, files, seconds, quality = SolveMemory(), {}, {}, {}
    with torch.no_grad():
        start = perf_counter()
        light_field = solve_light(scene, memory)
        light_seconds = perf_counter() - start
        for view in progress(views, "render"):
            start = perf_counter()
            images = _images(light_field, scene, view, has_components)
            seconds[view.name] = perf_counter() - start
            files[view.name] = [path.name for name, image in images.items() for path in _write(folder / name, image)]
            if view.image is not None:
                quality[view.name] = psnr(images[view.name], view.image, view.mask)
    solves = [{"kind": r.kind, "iterations": r.iterations, "residual": r.residual, "seconds": r.seconds} for r in memory.records]
    report = {
        "seconds": {"light": light_seconds, "views": seconds},
        "solves": solves,
        "physics": needed_terms(scene),
        "psnr": quality,
        "files": files,
    }
    write_json(folder / "render.json", report)
    return report


def _images(light_field: LightField, scene: Scene, view: View, has_components: bool) -> dict[str, Tensor]:
    if not has_components:
        return {view.name: view_image(light_field, scene, view.camera)}
    parts = view_components(light_field, scene, view.camera)
    named = {f"{view.name}.{name}": getattr(parts, name) for name in ("reduced", "single", "multiple")}
    return {view.name: parts.reduced + parts.single + parts.multiple, **named}


def _write(stem: Path, image: Tensor) -> list[Path]:
    array = pixels(image)
    preview = stem.with_name(stem.name + ".png")
    write_preview(preview, array)
    return [*write_linear(stem, array), preview]
