"""Rendered views as files: linear pixels, previews, derivative images, and a report of all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import UsageError
from ddrecon.extras import advice
from ddrecon.io.images.movies import encode_frames, write_animation, write_mp4
from ddrecon.io.images.table import PREVIEW, read_image, write_picture
from ddrecon.losses import Target
from ddrecon.progress import Progress
from ddrecon.ranks import (
    cells_are_shared,
    is_first,
    own_rank,
    rank_count,
    sum_numbers,
    sum_over_ranks,
)
from ddrecon.renderer import LightField, solve_light, view_components, view_picture
from ddrecon.report.pictures import diverging, find_white, pixels
from ddrecon.scene import Scene, View
from ddrecon.scene_file.problems import suggestion
from ddrecon.terms import needed_terms
from ddrecon.turntable import place_turntable
from ddrecon.variables.tangents import render_tangent, variation
from ddrecon.variables.values import component_names, value_of, variable_names

GRADIENT = "gradient"
"""Files of derivative images are named VIEW.gradient, and VIEW.gradient.single for a component."""


def render_to_folder(
    scene: Scene, views: list[View], folder: Path, has_components: bool, progress: Progress
) -> dict[str, Any]:
    """The report of rendering `views` of `scene`, with their components if wanted, to `folder`.

    The first rank alone writes.
    """
    memory, files, seconds, quality = SolveMemory(), {}, {}, {}
    with torch.no_grad():
        start = perf_counter()
        light_field = solve_light(scene, memory)
        light_seconds = perf_counter() - start
        turns = _render_in_turns(light_field, scene, views, has_components, progress)
        for view, images, taken in turns:
            if not is_first():
                continue
            seconds[view.name] = taken
            files[view.name] = [
                path.name
                for name, image in images.items()
                for path in write_picture(folder / name, pixels(image))
            ]
            if view.image is not None:
                loss = "display" if view.step else "l2"
                target = Target.of(view.image, view.mask, loss)
                quality[view.name] = float(target.psnr_of(images[view.name]))
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
    """As `render_to_folder`, with the images' derivatives with respect to `parameter`.

    `require_variation` must allow it.
    """
    memory, scales = SolveMemory(), {}
    seconds: dict[str, Any] = {}
    taken = {view.name: 0.0 for view in views}
    files: dict[str, list[str]] = {view.name: [] for view in views}

    def images_of(world: Scene) -> dict[tuple[str, str], Tensor]:
        start, images = perf_counter(), dict[tuple[str, str], Tensor]()
        light_field = solve_light(world, memory)
        seconds["light"] = perf_counter() - start
        own = views if cells_are_shared() else views[own_rank() :: rank_count()]
        for view in progress([world.view(view.name) for view in own], "render"):
            begun = perf_counter()
            images |= {
                (view.name, name): image
                for name, image in _images(light_field, world, view, has_components).items()
            }
            taken[view.name] = perf_counter() - begun
        return images

    with torch.no_grad():
        rendered = render_tangent(scene, parameter, images_of)
    found = {name: image for (_, name), (image, _) in rendered.items()}
    derived = {_derived(*key): derivative for key, (_, derivative) in rendered.items()}
    if not cells_are_shared():
        taken = dict(zip(taken, sum_numbers(list(taken.values())), strict=True))
    for view in views:
        names = _names(view, has_components)
        images = _bring(view, found, names)
        derivatives = _bring(view, derived, [_derived(view.name, name) for name in names])
        if not is_first():
            continue
        for name in names:
            written = write_picture(folder / name, pixels(images[name]))
            name = _derived(view.name, name)
            picture, scales[name] = diverging(derivatives[name])
            written += write_picture(folder / name, pixels(derivatives[name]), picture)
            files[view.name] += [path.name for path in written]
    return _report(scene, memory, seconds | {"views": taken}, files) | {
        "psnr": {},
        "gradient": {"parameter": parameter, "full_scale": scales},
    }


def write_ring(views: list[View], folder: Path, has_mp4: bool) -> dict[str, Any]:
    """What the report says of the movie `ring.png`, and `ring.mp4`, of all `views` in `folder`."""
    images = [read_image(folder / f"{view.name}.npy").pixels for view in views]
    white = max(map(find_white, images))
    frames, written = encode_frames(images, white), ["ring.png"]
    write_animation(folder / "ring.png", frames)
    if has_mp4:
        write_mp4(folder / "ring.mp4", frames)
        written.append("ring.mp4")
    return {"files": written, "white": white}


def remove_targets(scene: Scene, views: list[View], count: int | None) -> Scene:
    """`scene` with `views` alone, and without their target images.

    With `count`, so many views around the volume from the first of `views` take their place.
    """
    if count is not None:
        return replace(scene, views=place_turntable(scene, views[0], count))
    return replace(scene, views=[View(view.name, view.camera) for view in views])


def require_variation(scene: Scene, parameter: str) -> None:
    """Raises UsageError unless `parameter` names a number of `scene` or a component of one."""
    try:
        variation(scene, parameter)
    except UsageError as error:
        names = variable_names(scene)
        parts = [
            f"{name}.{part}"
            for name in names
            for part in component_names(name, value_of(scene, name))
        ]
        guess = "" if parameter in names else suggestion(parameter, [*names, *parts])
        raise UsageError(f"--gradient {parameter}: {error}{guess}") from None


def render_lines(report: dict[str, Any], folder: Path) -> list[str]:
    """What `render` prints of its `report`: files, quality and time of each view."""
    lines = []
    for name, files in report["files"].items():
        notes = [f"{report['seconds']['views'][name]:.2f} s"]
        notes += [f"PSNR {report['psnr'][name]:.1f} dB"] if name in report["psnr"] else []
        lines.append(f"{name}: {', '.join(files)} ({', '.join(notes)})")
    if not any(file.endswith(".exr") for files in report["files"].values() for file in files):
        lines.append(f"no .exr: EXR {advice('OpenImageIO')}")
    if "ring" in report:
        files, white = ", ".join(report["ring"]["files"]), report["ring"]["white"]
        lines.append(f"around: {files} (radiance {white:.3g} is white)")
    return [*lines, f"written to {folder}"]


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


def _derived(view: str, name: str) -> str:
    """What the derivative of the image of `view` called `name` is called."""
    return f"{view}.{GRADIENT}{name.removeprefix(view)}"


def _names(view: View, has_components: bool) -> list[str]:
    """What the images of `view` are called, in their order."""
    parts = ("reduced", "single", "multiple") if has_components else ()
    return [view.name, *(f"{view.name}.{part}" for part in parts)]


def _images(
    light_field: LightField, scene: Scene, view: View, has_components: bool
) -> dict[str, Tensor]:
    picture = view_picture(light_field, scene, view)
    if not has_components:
        return {view.name: picture}
    # As the camera exposes them; its offset, and what is behind, count as reduced.
    parts = view_components(light_field, scene, view.camera)
    gain = 1.0 if view.exposure is None else view.exposure.view(-1, 1, 1)
    single, multiple = gain * parts.single, gain * parts.multiple
    reduced = picture - single - multiple
    named = {"reduced": reduced, "single": single, "multiple": multiple}
    parts_of = {f"{view.name}.{name}": part for name, part in named.items()}
    return {view.name: reduced + single + multiple, **parts_of}


def _render_in_turns(
    light_field: LightField,
    scene: Scene,
    views: list[View],
    has_components: bool,
    progress: Progress,
) -> Iterator[tuple[View, Mapping[str, Tensor], float]]:
    """Each of `views`, its images, and the seconds that they took.

    With several ranks these are of a turn, in which each renders one view; where they share out
    cells, all render each view together.
    """
    ranks, rank = (1, 0) if cells_are_shared() else (rank_count(), own_rank())
    for begin in progress(range(0, len(views), ranks), "render"):
        turn, start = views[begin : begin + ranks], perf_counter()
        has_own = rank < len(turn)
        images = _images(light_field, scene, turn[rank], has_components) if has_own else {}
        seconds = perf_counter() - start
        for view in turn:
            yield view, _bring(view, images, _names(view, has_components)), seconds


def _bring(view: View, images: Mapping[str, Tensor], names: Sequence[str]) -> Mapping[str, Tensor]:
    """The images of `view` called `names`, from the rank that has them as `images`."""
    if rank_count() == 1 or cells_are_shared():
        return images
    nothing = view.camera.pose.new_zeros(3, *view.camera.size)
    stack = torch.stack([images.get(name, nothing) for name in names])
    return dict(zip(names, sum_over_ranks([stack])[0], strict=True))
