"""Rendered views as files: linear pixels, previews, derivative images, and a report of all."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.errors import UsageError, suggestion
from ddrecon.extras import advice, load_for_file
from ddrecon.io.files.atomic import write_json
from ddrecon.io.images.films import write_film
from ddrecon.io.images.table import (
    NO_LAYERS,
    PREVIEW,
    read_image,
    write_animation,
    write_array,
    write_picture,
    write_preview,
)
from ddrecon.light_field import LightField, fluence_of
from ddrecon.lighting import solve_light
from ddrecon.losses import Target
from ddrecon.medium.levels import resample
from ddrecon.picture import view_components, view_matte, view_picture
from ddrecon.pictures import srgb
from ddrecon.progress import Progress
from ddrecon.ranks import is_first, own_rank, rank_count, sum_over_ranks
from ddrecon.report.pictures import diverging, find_white, pixels
from ddrecon.run.run_folder import write_volume
from ddrecon.scene import Scene, View
from ddrecon.terms import needed_terms
from ddrecon.turntable import place_turntable
from ddrecon.variables.values import (
    component_names,
    value_of,
    variable_names,
    variation,
    varied,
)

GRADIENT = ".gradient"
"""Files of derivative images are named VIEW.gradient, and VIEW.gradient.single for a component."""
AT_REST = 0.01
"""Light that a transport round changes by a smaller part has come to rest."""
FEW = 12
"""Where there are more views, only the first and the last are printed."""
COMPONENTS = (".reduced", ".single", ".multiple")
MATTE = (".transmittance", ".depth")
FLUENCE = "volumes/fluence.npz"
MOVIES = {".mp4": write_film, ".png": write_animation}
"""What writes movies, by their suffixes."""


@dataclass(frozen=True)
class Choice:
    """What is rendered of a scene: the views `names`, or all; with a `count` so many around it.

    A scene that `is_relit` or `is_moved`, to a `size` (width, height) of its own, is compared with
    no picture. With a `parameter` there are derivatives by it as well. A `movie` has `fps` views a
    second.
    """

    names: tuple[str, ...] = ()
    components: bool = False
    parameter: str | None = None
    count: int | None = None
    has_fluence: bool = False
    is_relit: bool = False
    is_moved: bool = False
    size: tuple[int, int] | None = None
    movie: Path | None = None
    fps: float = 24.0


def choose_views(scene: Scene, choice: Choice) -> tuple[Scene, Sequence[View]]:
    """The scene that is rendered, and its views that are.

    Raises UsageError unless the parameter of the `choice` names a number of the scene.
    """
    if choice.has_fluence:
        # Light in empty cells, which views do not see, takes a second one.
        rounds = scene.diffusion.rounds
        scene.diffusion = replace(scene.diffusion, transport_rounds=rounds and max(rounds, 2))
    views = [scene.view(name) for name in dict.fromkeys(choice.names)] or scene.views
    if choice.count is not None:
        views = place_turntable(scene, views[0], choice.count)
        scene = replace(scene, views=views)
    elif choice.is_relit or choice.is_moved:
        views = [View(view.name, view.camera) for view in views]
        scene = replace(scene, views=views)
    if choice.parameter is not None:
        require_variation(scene, choice.parameter)
    return scene, views


def render_to_folder(
    scene: Scene, views: Sequence[View], folder: Path, choice: Choice, progress: Progress
) -> dict[str, Any]:
    """The report of rendering `views` of `scene` to `folder`, which it is written to as well.

    The first rank alone writes; that of others is empty.
    """
    memory, seconds, start = SolveMemory(), dict[str, float](), perf_counter()
    files, quality, scales = dict[str, list[str]](), dict[str, float](), dict[str, float]()
    with torch.no_grad(), varied(scene, choice.parameter) as world:
        light_field = solve_light(world, memory)
        light_seconds = perf_counter() - start
        if choice.has_fluence:
            _write_fluence(light_field, scene, folder)
        components = ["", *(COMPONENTS if choice.components else ())]
        names = [*components, *(MATTE if choice.components else ())]
        if choice.parameter is not None:
            names += [GRADIENT + name for name in components]
        for view, images, elapsed in _render_in_turns(light_field, world, views, names, progress):
            if not is_first():
                continue
            seconds[view.name], files[view.name] = elapsed, []
            stem = folder / view.name
            plain = {name: image for name, image in images.items() if not name.startswith(GRADIENT)}
            files[view.name] += _write_images(stem, plain)
            if choice.parameter is not None:
                slopes = {name: images[GRADIENT + name] for name in components}
                files[view.name] += _write_slopes(
                    stem.with_name(stem.name + GRADIENT), slopes, scales
                )
            if view.image is not None:
                loss = "display" if view.step else "l2"
                target = Target.of(view.image, view.mask, loss)
                quality[view.name] = float(target.psnr_of(images[""]))
    if not is_first():
        return {}
    solves = [{**asdict(r), "residual": float(r.residual)} for r in memory.records]
    report: dict[str, Any] = {
        "seconds": {"light": light_seconds, "views": seconds},
        "solves": solves,
        "physics": needed_terms(scene),
        "files": files,
        "preview": PREVIEW,
        "psnr": quality,
    }
    if rounds := [r for r in memory.records if r.kind == "rounds"]:
        report["rounds"] = {
            "count": rounds[-1].iterations,
            "residual": float(rounds[-1].residual),
            "tolerance": scene.diffusion.transport_tolerance,
        }
    if choice.has_fluence:
        report["fluence"] = [FLUENCE]
    if choice.parameter is not None:
        report["gradient"] = {"parameter": choice.parameter, "full_scale": scales}
    movie = choice.movie or (None if choice.count is None else folder / "ring.png")
    if movie is not None:
        report |= write_movie(views, folder, movie, choice.fps)
    write_json(folder / "render.json", report)
    return report


def _write_slopes(stem: Path, slopes: Mapping[str, Tensor], scales: dict[str, float]) -> list[str]:
    """As `_write_images`, of derivatives; the values of full red are added to `scales`, by file."""
    pairs = {name: diverging(slope) for name, slope in slopes.items()}
    scales |= {stem.name + name: full for name, (_, full) in pairs.items()}
    return _write_images(stem, slopes, {name: preview for name, (preview, _) in pairs.items()})


def _write_images(
    stem: Path, images: Mapping[str, Tensor], previews: Mapping[str, np.ndarray] = NO_LAYERS
) -> list[str]:
    """The names of files of the image called "" and of its components, layers of one .exr.

    Every component is an array as well and, but for the depth, a preview, its own or of `previews`.
    """
    arrays, layers, written = {name: pixels(i) for name, i in images.items()}, {}, list[Path]()
    picture = arrays.pop("")
    if MATTE[0] in arrays:
        arrays[MATTE[1]] = arrays[MATTE[1]][..., 0]
        layers = {"A": 1 - arrays[MATTE[0]].mean(-1), "Z": arrays[MATTE[1]]}
    layers |= {name[1:]: array for name, array in arrays.items() if array.ndim == 3}
    for name, array in arrays.items():
        path = stem.with_name(f"{stem.name}{name}.npy")
        write_array(path, array)
        written.append(path)
        if array.ndim == 3:
            written.append(path.with_suffix(".png"))
            write_preview(written[-1], previews.get(name, array))
    written = write_picture(stem, picture, previews.get(""), layers) + written
    return [path.name for path in written]


def _write_fluence(light_field: LightField, scene: Scene, folder: Path) -> None:
    """Writes the fluence to its file in `folder`, on the first rank."""
    fluence = resample(fluence_of(light_field, scene.diffusion), scene.volume.grid)
    fluence = forward_ad.unpack_dual(fluence).primal
    if is_first():
        write_volume(folder, "fluence", fluence, scene.volume.grid)


def require_movie(path: Path, views: Sequence[View], folder: Path) -> None:
    """Raises UsageError unless `views`, written to `folder`, can be frames of a movie at `path`.

    Raises FormatError where that takes a package which is not installed.
    """
    if path.suffix.lower() not in MOVIES:
        raise UsageError(f"--movie {path}: expected a name that ends in {' or '.join(MOVIES)}")
    if len({view.camera.size for view in views}) > 1:
        raise UsageError(f"--movie {path}: views differ in size; give them one by --size")
    if path.is_dir():
        raise UsageError(f"--movie {path}: is a folder")
    is_inside, names = path.resolve().parent == folder.resolve(), [f"{v.name}." for v in views]
    if is_inside and path.name.startswith(tuple(names)):
        raise UsageError(f"--movie {path}: is named as the files of a view; choose another name")
    if path.suffix.lower() == ".mp4":
        load_for_file("imageio_ffmpeg", path)


def write_movie(views: Sequence[View], folder: Path, path: Path, fps: float) -> dict[str, Any]:
    """What the report says of the movie at `path` of all `views` in `folder`.

    Its exposure is that of all previews from now on: the brightest view is just white.
    """
    images = [read_image(folder / f"{view.name}.npy").pixels for view in views]
    white = max(map(find_white, images))
    exposed = [image / white for image in images]
    MOVIES[path.suffix.lower()](path, [srgb.encode_bytes(image) for image in exposed], fps)
    for view, image in zip(views, exposed, strict=True):
        write_preview(folder / f"{view.name}.png", image)
    preview = f"sRGB of linear radiance: {white:.6g} and more is white"
    return {"movie": {"file": str(path), "white": white}, "preview": preview}


def require_variation(scene: Scene, parameter: str) -> None:
    """Raises UsageError unless `parameter` names a number of `scene` or a component of one."""
    try:
        variation(scene, parameter)
    except UsageError as error:
        names = variable_names(scene)
        components = [
            f"{name}.{component}"
            for name in names
            for component in component_names(name, value_of(scene, name))
        ]
        guess = "" if parameter in names else suggestion(parameter, [*names, *components])
        raise UsageError(f"--gradient {parameter}: {error}{guess}") from None


def render_lines(report: dict[str, Any], folder: Path, is_quiet: bool) -> list[str]:
    """What `render` prints of its `report`: files, quality and time of each view.

    More than `FEW` views, or two if it `is_quiet`, are cut to the first and the last.
    """
    lines = []
    for name, files in report["files"].items():
        notes = [f"{report['seconds']['views'][name]:.2f} s"]
        notes += [f"PSNR {report['psnr'][name]:.1f} dB"] if name in report["psnr"] else []
        lines.append(f"{name}: {', '.join(files)} ({', '.join(notes)})")
    if len(lines) > (2 if is_quiet else FEW):
        lines[1:-1] = [f"... {len(lines) - 2} views between them, in render.json"]
    if not any(file.endswith(".exr") for files in report["files"].values() for file in files):
        lines.append(f"no .exr: EXR {advice('OpenImageIO')}")
    if "rounds" in report:
        lines.append(rounds_text(**report["rounds"]))
    if "fluence" in report:
        lines.append(f"fluence: {FLUENCE}")
    if "movie" in report:
        lines.append("movie: {file} (radiance {white:.3g} is white)".format(**report["movie"]))
    return [*lines, f"written to {folder}"]


def rounds_text(count: int, residual: float, tolerance: float | None) -> str:
    """How many transport rounds there were, and whether light has come to rest in them (E7.3).

    It has where the last round changed light by less than the `tolerance`, or `AT_REST`.
    """
    if residual < (tolerance or AT_REST):
        verdict = "at rest"
    elif count == 1:
        verdict = "what diffusion alone lacks; a second round tells what is left"
    else:
        verdict = "not at rest; more may help (diffusion.transport_rounds)"
    changed = f"{100 * residual:.2g} %"
    return f"transport rounds: {count}, the last changed light by {changed}: {verdict}"


def _images(
    light_field: LightField, scene: Scene, view: View, names: Sequence[str]
) -> dict[str, Tensor]:
    picture = view_picture(light_field, scene, view)
    images = {"": picture}
    if COMPONENTS[0] in names:
        # As the camera exposes them; its offset, and what is behind, count as reduced.
        components = view_components(light_field, scene, view.camera)
        gain = 1.0 if view.exposure is None else view.exposure.view(-1, 1, 1)
        single, multiple = gain * components.single, gain * components.multiple
        reduced = picture - single - multiple
        matte = view_matte(light_field, scene, view.camera)
        depth = matte.depth.expand_as(picture)
        total, through = reduced + single + multiple, matte.transmittance
        layers = total, reduced, single, multiple, through, depth
        images = dict(zip(("", *COMPONENTS, *MATTE), layers, strict=True))
    pairs = {name: forward_ad.unpack_dual(image) for name, image in images.items()}
    plain = {name: pair.primal for name, pair in pairs.items()}
    derived = {
        GRADIENT + name: torch.zeros_like(pair.primal) if pair.tangent is None else pair.tangent
        for name, pair in pairs.items()
    }
    return {name: (plain | derived)[name] for name in names}


def _render_in_turns(
    light_field: LightField,
    scene: Scene,
    views: Sequence[View],
    names: Sequence[str],
    progress: Progress,
) -> Iterator[tuple[View, Mapping[str, Tensor], float]]:
    """Each of `views`, its images by `names`, the ends of their files, and the seconds they took.

    With several ranks these are of a turn, in which each renders one view.
    """
    ranks, rank = rank_count(), own_rank()
    for begin in progress(range(0, len(views), ranks), "render"):
        turn, start = views[begin : begin + ranks], perf_counter()
        images = dict[str, Tensor]()
        if rank < len(turn):
            images = _images(light_field, scene, scene.view(turn[rank].name), names)
        seconds = perf_counter() - start
        for place, view in enumerate(turn):
            if ranks > 1:
                nothing = view.camera.pose.new_zeros(3, *view.camera.size)
                contributions = [images[name] if place == rank else nothing for name in names]
                yield view, dict(zip(names, sum_over_ranks(contributions), strict=True)), seconds
            else:
                yield view, images, seconds
