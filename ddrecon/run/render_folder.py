"""Rendered views as files: linear pixels, previews, derivative images, movies, a record of all."""

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
from ddrecon.errors import UsageError
from ddrecon.extras import advice, load_extra
from ddrecon.io.files.atomic import write_json
from ddrecon.io.images.films import write_film
from ddrecon.io.images.table import (
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
from ddrecon.medium.coefficients import resample
from ddrecon.picture import view_components, view_matte, view_picture
from ddrecon.pictures import encode_bytes
from ddrecon.progress import show_progress
from ddrecon.ranks import is_first, own_rank, rank_count, sum_over_ranks
from ddrecon.report.pictures import diverging, find_white, pixels
from ddrecon.run.job import Outcome
from ddrecon.run.run_folder import write_volume
from ddrecon.scene import Scene, View, place_turntable
from ddrecon.terms import needed_terms
from ddrecon.variables.values import (
    variation,
    varied,
)

GRADIENT = ".gradient"
"""Files of derivative images are named VIEW.gradient, and VIEW.gradient.single for a component."""
COMPONENTS, MATTE = (".reduced", ".single", ".multiple"), (".transmittance", ".depth")
AT_REST = 0.01
"""Light that a transport round changes by a smaller part has come to rest."""
FEW = 12
"""Where there are more views, only the first and the last are printed."""
MOVIES = {".mp4": write_film, ".png": write_animation}
"""What writes movies, by their suffixes."""


@dataclass(frozen=True)
class Choice:
    """What is rendered of a scene: the views `names`, or all; with a `count` so many around it.

    With a `parameter` there are derivatives by it as well. A `movie` has `fps` views a second.
    """

    names: tuple[str, ...] = ()
    components: bool = False
    parameter: str | None = None
    count: int | None = None
    has_fluence: bool = False
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
    if (parameter := choice.parameter) is not None:
        try:
            variation(scene, parameter)
        except UsageError as error:
            raise UsageError(f"--gradient {parameter}: {error}") from None
    return scene, views


def require_movie(path: Path, views: Sequence[View], folder: Path) -> None:
    """Raises UsageError unless `views`, written to `folder`, can be frames of a movie at `path`.

    Raises FormatError where that takes a package which is not installed.
    """
    is_inside, names = path.resolve().parent == folder.resolve(), [f"{v.name}." for v in views]
    fault = None
    if path.suffix.lower() not in MOVIES:
        fault = f"expected a name that ends in {' or '.join(MOVIES)}"
    elif len({view.camera.size for view in views}) > 1:
        fault = "views differ in size; give them one by --size"
    elif path.is_dir():
        fault = "is a folder"
    elif is_inside and path.name.startswith(tuple(names)):
        fault = "is named as the files of a view; choose another name"
    if fault is not None:
        raise UsageError(f"--movie {path}: {fault}")
    if path.suffix.lower() == ".mp4":
        load_extra("imageio_ffmpeg", path)


def render_to_folder(scene: Scene, views: Sequence[View], folder: Path, choice: Choice) -> Outcome:
    """Renders `views` of `scene` to `folder`, with `render.json`; the first rank alone tells."""
    memory, seconds, start = SolveMemory(), dict[str, float](), perf_counter()
    files, quality, scales = dict[str, list[str]](), dict[str, float](), dict[str, float]()
    components = ["", *(COMPONENTS if choice.components else ())]
    names = [*components, *(MATTE if choice.components else ())]
    if choice.parameter is not None:
        names += [GRADIENT + name for name in components]
    with torch.no_grad(), varied(scene, choice.parameter) as world:
        light_field = solve_light(world, memory)
        light_seconds = perf_counter() - start
        fluence = ""
        if choice.has_fluence:
            cells = resample(fluence_of(light_field, scene.diffusion), scene.volume.grid)
            if is_first():
                cells = forward_ad.unpack_dual(cells).primal
                fluence = write_volume(folder, "fluence", cells, scene.volume.grid)
        for view, images, elapsed in _render_in_turns(light_field, world, views, names):
            if not is_first():
                continue
            seconds[view.name] = elapsed
            slopes = {n.removeprefix(GRADIENT): images.pop(n) for n in names if GRADIENT in n}
            files[view.name] = _write_images(folder / view.name, images)
            if slopes:
                files[view.name] += _write_images(folder / (view.name + GRADIENT), slopes, scales)
            if view.image is not None:
                target = Target.of(view.image, view.mask, "display" if view.step else "l2")
                quality[view.name] = float(target.psnr_of(images[""]))
    if not is_first():
        return {}, []
    record: dict[str, Any] = {
        "seconds": {"light": light_seconds, "views": seconds},
        "solves": [{**asdict(r), "residual": float(r.residual)} for r in memory.records],
        "physics": [*needed_terms(scene)],
        "files": files,
        "preview": PREVIEW,
        "psnr": quality,
    }
    lines = _tell_views(files, seconds, quality)
    if rounds := [r for r in memory.records if r.kind == "rounds"]:
        tolerance = scene.diffusion.transport_tolerance
        last = {"count": rounds[-1].iterations, "residual": float(rounds[-1].residual)}
        record["rounds"] = last | {"tolerance": tolerance}
        lines.append(rounds_text(**record["rounds"]))
    if fluence:
        record["fluence"] = [fluence]
        lines.append(f"fluence: {fluence}")
    if choice.parameter is not None:
        record["gradient"] = {"parameter": choice.parameter, "full_scale": scales}
    movie = choice.movie or (None if choice.count is None else folder / "ring.png")
    if movie is not None:
        white = _write_movie(views, folder, movie, choice.fps)
        record["movie"] = {"file": str(movie), "white": white}
        record["preview"] = f"sRGB of linear radiance: {white:.6g} and more is white"
        lines.append(f"movie: {movie} (radiance {white:.3g} is white)")
    write_json(folder / "render.json", record)
    return record, lines


def _tell_views(
    files: Mapping[str, Sequence[str]], seconds: Mapping[str, float], quality: Mapping[str, float]
) -> list[str]:
    """A line of each view, of many of the first and the last, and one where no .exr is written."""
    lines = []
    for name, written in files.items():
        psnr = f", PSNR {quality[name]:.1f} dB" if name in quality else ""
        lines.append(f"{name}: {', '.join(written)} ({seconds[name]:.2f} s{psnr})")
    if len(lines) > FEW:
        lines[1:-1] = [f"... {len(lines) - 2} views between them, in render.json"]
    if not any(file.endswith(".exr") for written in files.values() for file in written):
        lines.append(f"no .exr: EXR {advice('OpenImageIO')}")
    return lines


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
    changed = f"{100 * residual:.3g} %"
    return f"transport rounds: {count}, the last changed light by {changed}: {verdict}"


def _write_images(
    stem: Path, images: Mapping[str, Tensor], scales: dict[str, float] | None = None
) -> list[str]:
    """The names of files of the image called "" and of its components, layers of one .exr.

    Every component is an array as well and, but for the depth, a preview. Where these are signed,
    the values of full red are added to `scales`.
    """
    previews = dict[str, np.ndarray]()
    if scales is not None:
        for name, image in images.items():
            previews[name], scales[stem.name + name] = diverging(image)
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


def _write_movie(views: Sequence[View], folder: Path, path: Path, fps: float) -> float:
    """Writes a movie of all `views` in `folder`; the radiance that is white in it.

    Its exposure is that of all previews from now on: the brightest view is just white.
    """
    # One after another, and twice: all of them as floats may take more memory than there is.
    stems, frames = [folder / view.name for view in views], list[np.ndarray]()
    white = max(find_white(read_image(Path(f"{stem}.npy")).pixels) for stem in stems)
    for stem in stems:
        exposed = read_image(Path(f"{stem}.npy")).pixels / white
        frames.append(encode_bytes(exposed))
        write_preview(Path(f"{stem}.png"), exposed)
    MOVIES[path.suffix.lower()](path, frames, fps)
    return white


def _render_in_turns(
    light_field: LightField,
    scene: Scene,
    views: Sequence[View],
    names: Sequence[str],
) -> Iterator[tuple[View, dict[str, Tensor], float]]:
    """Each of `views`, its images by `names`, the ends of their files, and the seconds they took.

    With several ranks these are of a turn, in which each renders one view.
    """
    ranks, rank = rank_count(), own_rank()
    for begin in show_progress(range(0, len(views), ranks), "render"):
        turn, start = views[begin : begin + ranks], perf_counter()
        images = dict[str, Tensor]()
        if rank < len(turn):
            images = _images(light_field, scene, scene.view(turn[rank].name), names)
        seconds = perf_counter() - start
        for place, view in enumerate(turn):
            nothing = view.camera.pose.new_zeros(3, *view.camera.size)
            shares = [images[name] if place == rank else nothing for name in names]
            yield view, dict(zip(names, sum_over_ranks(shares), strict=True)), seconds


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
        layers = reduced + single + multiple, reduced, single, multiple
        mattes = matte.transmittance, matte.depth.expand_as(picture)
        images = dict(zip(("", *COMPONENTS, *MATTE), (*layers, *mattes), strict=True))
    for name, image in [*images.items()]:
        images[name], slope = forward_ad.unpack_dual(image)
        images[GRADIENT + name] = torch.zeros_like(images[name]) if slope is None else slope
    return {name: images[name] for name in names}
