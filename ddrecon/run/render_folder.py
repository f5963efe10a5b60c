"""Rendered views as files: linear pixels, previews, derivative images, and a report of what it
took.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import SceneError
from ddrecon.io.images.movies import encode_frames, write_animation, write_mp4
from ddrecon.io.images.table import PREVIEW, read_image, write_picture
from ddrecon.losses import psnr
from ddrecon.renderer import LightField, solve_light, view_components, view_image
from ddrecon.report.pictures import diverging, find_white, pixels
from ddrecon.scene import Scene, View
from ddrecon.terms import needed_terms
from ddrecon.variables.tangents import render_tangent, variation

GRADIENT = "gradient"
"""Files of derivative images are named VIEW.gradient, and VIEW.gradient.single for a component."""
Progress = Callable[[list[View], str], Iterable[View]]


def render_to_folder(
    scene: Scene, views: list[View], folder: Path, has_components: bool, progress: Progress
) -> dict[str, Any]:
    """Renders `views` of `scene` into `folder` and returns a report of it."""
    memory, files, seconds, quality = SolveMemory(), {}, {}, {}
    with torch.no_grad():
        start = perf_counter()
        light_field = solve_light(scene, memory)
        light_seconds = perf_counter() - start
        for view in progress(views, "render"):
            start = perf_counter()
            images = _images(light_field, scene, view, has_components)
            seconds[view.name] = perf_counter() - start
            files[view.name] = [
                path.name
                for name, image in images.items()
                for path in write_picture(folder / name, pixels(image))
            ]
            if view.image is not None:
                quality[view.name] = psnr(images[view.name], view.image, view.mask)
    return _report(scene, memory, {"light": light_seconds, "views": seconds}, files) | {
        "psnr": quality
    }


def render_gradient_to_folder(
    scene: Scene,
    views: list[View],
    folder: Path,
    has_components: bool,
    parameter: str,
    progress: Progress,
) -> dict[str, Any]:
    """Renders `views` of `scene` and their derivatives with respect to `parameter`, which
    `require_variation` allows, into `folder`.
    """
    memory, scales = SolveMemory(), {}
    seconds: dict[str, Any] = {"views": {}}
    files: dict[str, list[str]] = {view.name: [] for view in views}

    def images_of(world: Scene) -> dict[tuple[str, str], Tensor]:
        start, images = perf_counter(), dict[tuple[str, str], Tensor]()
        light_field = solve_light(world, memory)
        seconds["light"] = perf_counter() - start
        for view in progress([world.view(view.name) for view in views], "render"):
            begun = perf_counter()
            images |= {
                (view.name, name): image
                for name, image in _images(light_field, world, view, has_components).items()
            }
            seconds["views"][view.name] = perf_counter() - begun
        return images

    with torch.no_grad():
        rendered = render_tangent(scene, parameter, images_of)
    for (view, name), (image, derivative) in rendered.items():
        derived = f"{view}.{GRADIENT}{name.removeprefix(view)}"
        picture, scales[derived] = diverging(derivative)
        written = write_picture(folder / name, pixels(image)) + write_picture(
            folder / derived, pixels(derivative), picture
        )
        files[view] += [path.name for path in written]
    return _report(scene, memory, seconds, files) | {
        "psnr": {},
        "gradient": {"parameter": parameter, "full_scale": scales},
    }


def write_ring(views: list[View], folder: Path, has_mp4: bool) -> dict[str, Any]:
    """Writes the images of `views` in `folder` as one movie, `ring.png` and where asked for
    `ring.mp4`; what the report says of it.
    """
    images = [read_image(folder / f"{view.name}.npy").pixels for view in views]
    white = max(map(find_white, images))
    frames, written = encode_frames(images, white), ["ring.png"]
    write_animation(folder / "ring.png", frames)
    if has_mp4:
        write_mp4(folder / "ring.mp4", frames)
        written.append("ring.mp4")
    return {"files": written, "white": white}


def require_variation(scene: Scene, parameter: str) -> None:
    """Raises SceneError unless `parameter` names a number of `scene` or a component of one."""
    try:
        variation(scene, parameter)
    except KeyError as error:
        raise SceneError(f"--gradient {parameter}: {error.args[0]}") from None


def _report(
    scene: Scene, memory: SolveMemory, seconds: dict[str, Any], files: dict[str, list[str]]
) -> dict[str, Any]:
    solves = [
        {"kind": r.kind, "iterations": r.iterations, "residual": r.residual, "seconds": r.seconds}
        for r in memory.records
    ]
    return {
        "seconds": seconds,
        "solves": solves,
        "physics": needed_terms(scene),
        "files": files,
        "preview": PREVIEW,
    }


def _images(
    light_field: LightField, scene: Scene, view: View, has_components: bool
) -> dict[str, Tensor]:
    if not has_components:
        return {view.name: view_image(light_field, scene, view.camera)}
    parts = view_components(light_field, scene, view.camera)
    named = {
        f"{view.name}.{name}": getattr(parts, name) for name in ("reduced", "single", "multiple")
    }
    return {view.name: parts.reduced + parts.single + parts.multiple, **named}
