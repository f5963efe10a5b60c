"""Commands of scenes and runs: check, render, optimize, uncertainty.

torch is imported inside the commands, after their scene is read: help, and what is wrong with a
scene file, are shown at once.
"""

from __future__ import annotations

import json
from itertools import chain
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any
from warnings import warn

import click

from ddrecon.cli.command import (
    DTYPE,
    OUTPUT,
    OVERWRITE,
    REPORT,
    SCENE,
    UP,
    FiniteRange,
    in_session,
)
from ddrecon.errors import DataWarning, UsageError
from ddrecon.settings import MOST_AROUND

if TYPE_CHECKING:
    from ddrecon.cli.session import Session
    from ddrecon.film.folder import Film


MOST_SIDE = 2**15
"""Pixels along a side, at most."""


@click.command()
@SCENE
@DTYPE
@REPORT
@in_session
def check(session: Session, scene: Path) -> None:
    """Validate SCENE and print its grid, views, engine, memory and the physics it needs."""
    scene_file = session.read(scene)
    from ddrecon.cli.check import describe, lines, supports_of
    from ddrecon.progress import tell
    from ddrecon.scene_file.build_views import each_frame, require_frames

    if scene_file.tree.frames is not None:
        require_frames(scene_file)
    scenes = map(session.build, each_frame(scene_file))
    with tell("reading pictures, and looking at what they show", session.is_quiet):
        first = next(scenes)
        supports = supports_of(chain([first], scenes))
        report = describe(first, supports)
    support = report["support"] or {}
    if (doubt := support.get("doubt")) and "cells" not in support:
        raise scene_file.refused("volume.bounds", doubt)
    for text in (doubt and f"volume.bounds: {doubt}", support.get("cut")):
        if text is not None:
            warn(text, DataWarning, 2)
    session.show(report, lines(report))


@click.command()
@SCENE
@DTYPE
@REPORT
@in_session
def balance(session: Session, scene: Path) -> None:
    """Print what power enters the box of SCENE, what is absorbed in it and what leaves it."""
    loaded = session.load(scene)
    from ddrecon.validate.balance import find_balance, lines

    report = find_balance(loaded)
    session.show(report, lines(report))


@click.command()
@SCENE
@OUTPUT
@OVERWRITE
@click.option(
    "--view", "names", multiple=True, metavar="NAME", help="Render only this view; repeatable."
)
@click.option(
    "--components",
    is_flag=True,
    help="Also write reduced, single and multiple radiance, transmittance and depth; the .exr has"
    " them all, and alpha, as layers.",
)
@click.option(
    "--gradient",
    "parameter",
    metavar="PARAM",
    help="Also write each image's derivative: density, g, lights.0.direction.x, ...",
)
@click.option(
    "--light",
    "lights",
    multiple=True,
    metavar="LIGHT",
    help="Light it by '{type: directional, ...}' instead; repeatable.",
)
@click.option(
    "--ring",
    "count",
    type=click.IntRange(2, MOST_AROUND),
    metavar="N",
    help="N views around the volume instead, and a movie of them, ring.png or --movie.",
)
@click.option(
    "--cameras",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="The cameras of a transforms.json instead; its pictures need not be there.",
)
@click.option(
    "--size",
    type=(click.IntRange(1, MOST_SIDE), click.IntRange(1, MOST_SIDE)),
    metavar="W H",
    help="Pixels across and down instead, of the same width of view.",
)
@click.option(
    "--movie",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="And a movie of all views in their order, .mp4 or .png, at one exposure.",
)
@click.option(
    "--fps",
    type=FiniteRange(1, 240),
    default=24.0,
    show_default=True,
    help="Its pictures a second.",
)
@click.option("--fluence", "has_fluence", is_flag=True, help="And volumes/fluence.npz.")
@click.option("--frames", metavar="A:B", help="Of a film, the frames from A to B alone.")
@DTYPE
@REPORT
@in_session
def render(
    session: Session,
    scene: Path,
    output: Path,
    lights: tuple[str, ...],
    cameras: Path | None,
    frames: str | None,
    overwrite: bool,
    **options: Any,
) -> None:
    """Render the views of SCENE, a scene file or the folder of a finished run, or of a film."""
    if options["count"] is not None and len(options["names"]) > 1:
        raise click.UsageError("--ring goes around from one view: say --view once")
    if cameras is not None:
        typed, path = f"--cameras {cameras}", json.dumps(str(cameras))
        session = session.with_override(f"views={{transforms: {path}}}", typed)
        session = session.with_override("optimize=", typed)
    if lights:
        typed = " ".join(f"--light {light}" for light in lights)
        session = session.with_override(f"lights=[{', '.join(lights)}]", typed)
    from ddrecon.io.files.folders import FILM, RENDER, kind_of_folder

    is_moved = cameras is not None or options["size"] is not None
    options |= {"is_relit": bool(lights), "is_moved": is_moved}
    if kind_of_folder(scene) != FILM:
        if frames is not None:
            raise click.UsageError("--frames is for the folders of films: SCENE is none")
        session.show(*_render(session, scene, output, overwrite, options))
        return
    if options["movie"] is not None:
        raise click.UsageError("--movie is of one frame: name it, such as FILM/frames/0003")
    from ddrecon.film.folder import finished_frames

    with session.claim(output, RENDER, overwrite=overwrite) as folder:
        runs = finished_frames(scene, frames)
        if folder is not None and frames is None:
            folder.clear()
        pairs = {
            run.name: _render(session, run, output / run.name, overwrite, options) for run in runs
        }
    session.show(
        {name: report for name, (report, _) in pairs.items()},
        [*chain.from_iterable(lines for _, lines in pairs.values())],
    )


def _render(
    session: Session, scene: Path, output: Path, overwrite: bool, options: dict[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """The report of `render` on the one `scene`, and its lines; on the first rank alone."""
    scene_file = session.read(scene)
    from ddrecon.io.files.folders import RENDER, require_free_files
    from ddrecon.run.render_folder import (
        Choice,
        choose_views,
        render_lines,
        render_to_folder,
        require_movie,
    )
    from ddrecon.scene_file.build_views import remove_pictures
    from ddrecon.scene_file.load import referenced_files

    choice = Choice(**options)
    with session.claim(output, RENDER, overwrite=overwrite) as folder:
        if choice.is_moved:
            scene_file = remove_pictures(scene_file, choice.size)
        chosen = choose_views(session.build(scene_file), choice)
        if choice.movie is not None and folder is not None:
            require_free_files([choice.movie], may_exist=overwrite)
            require_movie(choice.movie, chosen[1], output)
        if folder is not None:
            folder.clear([scene_file.path, *referenced_files(scene_file)])
        report = render_to_folder(*chosen, output, choice, session.progress)
    return report, render_lines(report, output, session.quiet) if report else []


@click.command()
@SCENE
@OUTPUT
@OVERWRITE
@click.option(
    "--iterations",
    metavar="N|auto",
    help="Total number of iterations, also after --resume; auto: the run ends by itself.",
)
@click.option("--resume", is_flag=True, help="Go on from the folder's checkpoint.")
@click.option(
    "--preview-every",
    type=click.IntRange(min=1),
    metavar="K",
    help="Write pictures every K iterations.",
)
@click.option("--frames", metavar="A:B", help="Of a film, the frames from A to B alone.")
@click.option(
    "--shared",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Of a film, hold the calibration that FILE, another film's shared.json, says.",
)
@click.option(
    "--export",
    "exported",
    type=click.Choice(["vdb", "npz"]),
    help="Of a film, also write sequence/film_0000.vdb and so on: all fields, and the velocity.",
)
@UP
@DTYPE
@REPORT
@in_session
def optimize(
    session: Session,
    scene: Path,
    output: Path,
    overwrite: bool,
    iterations: str | None,
    resume: bool,
    preview_every: int | None,
    frames: str | None,
    shared: Path | None,
    exported: str | None,
    up: str | None,
) -> None:
    """Reconstruct what SCENE asks for from its views' images, of a film frame after frame."""
    from ddrecon.run.result import RESULT

    of_run = (scene.parent if scene.name == RESULT else scene) / "scene.yaml"
    if of_run.is_file() and of_run.with_name(RESULT).is_file():
        raise UsageError(
            f"{scene}: a finished run leaves nothing to optimize; name its scene, {of_run}, "
            "and another folder or --resume --iterations N"
        )
    if up is not None and exported is None:
        raise click.UsageError("--up turns what --export writes: say --export as well")
    if iterations is not None:
        typed = f"--iterations {iterations}"
        session = session.with_override(f"optimize.iterations={iterations}", typed)
    scene_file = session.read(scene)
    if scene_file.tree.frames is not None:
        from ddrecon.film.folder import Film

        film = Film(scene_file, output, session.build, {}, preview_every, session.is_quiet)
        choice = {"overwrite": overwrite, "resume": resume, "shared": shared}
        _optimize_film(session, film, frames, (exported, up), choice)
        return
    film_options = {"--frames": frames, "--shared": shared, "--export": exported}
    if of_films := [option for option, value in film_options.items() if value is not None]:
        raise click.UsageError(f"{of_films[0]} is for films: SCENE has no section frames")
    from ddrecon.diffusion.solve import name_kernels
    from ddrecon.io.files.folders import RUN
    from ddrecon.progress import tell
    from ddrecon.run.drive import optimize_in_folder, summary_lines

    with session.claim(output, RUN, overwrite=overwrite, resume=resume) as claimed:
        with tell("reading pictures and building the scene", session.is_quiet):
            if scene_file.tree.diffusion.is_conservative_p1:
                name_kernels(session.empty())
            built, environment = session.build(scene_file), session.environment()
        options: dict[str, Any] = {"preview_every": preview_every, "is_quiet": session.is_quiet}
        arguments = built, scene_file, claimed, environment
        summary = optimize_in_folder(*arguments, is_resumed=resume, **options)
    if summary:
        session.show(summary, summary_lines(summary, output, monotonic() - session.begun))


def _optimize_film(
    session: Session,
    film: Film,
    frames: str | None,
    exported: tuple[str | None, str | None],
    choice: dict[str, Any],
) -> None:
    """Reconstructs the frames of `film` that are this rank's; `choice` is how its folder opens."""
    from ddrecon.film.drive import drive_film, share_out
    from ddrecon.film.folder import choose_frames, open_film
    from ddrecon.film.report import film_lines
    from ddrecon.ranks import alone, from_first, is_first

    numbers = share_out(choose_frames(film.frames.numbers, frames))
    film.environment = session.environment()
    if not is_first():
        from_first(None)  # others find the folder as it is to be
        choice = {"overwrite": False, "resume": True, "shared": None}
    with open_film(film, frames, numbers, **choice):
        if is_first():
            from_first(None)
        with alone():
            record = drive_film(film, numbers, *exported)
    session.show(record, film_lines(record, film.path))


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@OUTPUT
@OVERWRITE
@click.option(
    "--calibrate",
    "experiments",
    type=click.IntRange(min=1),
    default=2,
    show_default=True,
    metavar="N",
    help="Experiments, each as long as RUN was: what it found is photographed and reconstructed, "
    "and how far off that is are the deviations. In all, also after --resume.",
)
@click.option("--resume", is_flag=True, help="Go on with the folder's experiments.")
@REPORT
@in_session
def uncertainty(
    session: Session,
    run: Path,
    output: Path,
    overwrite: bool,
    experiments: int,
    resume: bool,
) -> None:
    """Say by experiments how sure RUN, the folder of a finished run, is of each cell and number."""
    from ddrecon.io.files.folders import UNCERTAINTY
    from ddrecon.run.result import require_no_film
    from ddrecon.run.run_folder import load_run
    from ddrecon.uncertainty.experiments import Uncertainty
    from ddrecon.uncertainty.folder import experiment_in_folder, uncertainty_lines

    require_no_film(run)
    reconstruction = load_run(
        run, lambda dtype: session.build(session.read(run / "scene.yaml"), dtype)
    )
    if reconstruction.level.train.volume.grid != reconstruction.problem.scene.volume.grid:
        raise UsageError(
            f"{run}: the run stopped before its last resolution; finish it with "
            "`ddrecon optimize --resume`"
        )
    job = Uncertainty(reconstruction, session.seed, experiments)
    with session.claim(output, UNCERTAINTY, overwrite=overwrite, resume=resume) as folder:
        record = experiment_in_folder(job, folder, is_resumed=resume, is_quiet=session.is_quiet)
    if record:
        session.show(record, uncertainty_lines(record, output))
