"""Commands of scenes and runs: check, balance, render, optimize, uncertainty.

torch is imported inside the commands, after their scene is read: help, and what is wrong with a
scene file, are shown at once.
"""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any
from warnings import warn

import click

from ddrecon.cli.command import command
from ddrecon.errors import DataWarning, UsageError

if TYPE_CHECKING:
    from ddrecon.cli.session import Session
    from ddrecon.run.job import Outcome
    from ddrecon.scene_file.load import SceneFile


@command("SCENE", "dtype report")
def check(session: Session, source: Path) -> None:
    """Validate SCENE and print its grid, views, engine, memory and the physics it needs."""
    scene_file = session.read(source)
    from ddrecon.cli.check import describe, supports_of
    from ddrecon.progress import tell
    from ddrecon.scene_file.build_views import each_frame, require_frames

    if scene_file.tree.frames is not None:
        require_frames(scene_file)
    scenes = map(session.build, each_frame(scene_file))
    with tell("reading pictures, and looking at what they show"):
        first = next(scenes)
        supports = supports_of(chain([first], scenes))
        report, lines = describe(first, supports)
    support = report["support"] or {}
    if (doubt := support.get("doubt")) and "cells" not in support:
        raise scene_file.refused("volume.bounds", doubt)
    for text in (doubt and f"volume.bounds: {doubt}", support.get("cut")):
        if text is not None:
            warn(text, DataWarning, 2)
    session.show(report, lines)


@command("SCENE", "dtype report")
def balance(session: Session, source: Path) -> None:
    """Print what power enters the box of SCENE, what is absorbed in it and what leaves it."""
    scene = session.load(source)
    from ddrecon.validate.balance import find_balance, lines

    report = find_balance(scene)
    session.show(report, lines(report))


RENDERED = "names components parameter count movie fps has_fluence"


@command(
    "SCENE", f"output overwrite lights cameras size frames {RENDERED} dtype report", is_shared=True
)
def render(
    session: Session,
    source: Path,
    lights: tuple[str, ...],
    cameras: Path | None,
    size: tuple[int, int] | None,
    frames: str | None,
    **choice: Any,
) -> None:
    """Render the views of SCENE, a scene file or the folder of a finished run, or of a film."""
    if choice["count"] is not None and len(choice["names"]) > 1:
        raise click.UsageError("--ring goes around from one view: say --view once")
    if cameras is not None:
        typed, path = f"--cameras {cameras}", json.dumps(str(cameras))
        session = session.with_override(f"views={{transforms: {path}}}", typed)
        session = session.with_override("optimize=", typed)
    if lights:
        typed = " ".join(f"--light {light}" for light in lights)
        session = session.with_override(f"lights=[{', '.join(lights)}]", typed)
    from ddrecon.io.files.folders import FILM, RENDER, kind_of_folder

    # What is lit or seen otherwise is compared with no picture.
    is_bare = bool(lights) or cameras is not None or size is not None
    if kind_of_folder(source) != FILM:
        if frames is not None:
            raise click.UsageError("--frames is for the folders of films: SCENE is none")
        session.show(*_render(session, source, is_bare, size, choice))
        return
    if choice["movie"] is not None:
        raise click.UsageError("--movie is of one frame: name it, such as FILM/frames/0003")
    from ddrecon.film import finished_frames

    outcomes: dict[str, Outcome] = {}
    with session.claim(RENDER) as folder:
        runs = finished_frames(source, frames)
        if folder is not None and frames is None:
            folder.clear()
        for run in runs:
            of_frame = replace(session, output=session.output / run.name)
            outcomes[run.name] = _render(of_frame, run, is_bare, size, choice)
    records = {name: record for name, (record, _) in outcomes.items()}
    session.show(records, [line for _, lines in outcomes.values() for line in lines])


def _render(
    session: Session,
    source: Path,
    is_bare: bool,
    size: tuple[int, int] | None,
    choice: dict[str, Any],
) -> Outcome:
    """Renders one scene, without its pictures where it `is_bare`."""
    scene_file = session.read(source)
    from ddrecon.io.files.folders import RENDER, require_free_files
    from ddrecon.run.render_folder import Choice, choose_views, render_to_folder, require_movie
    from ddrecon.scene_file.build_views import remove_pictures
    from ddrecon.scene_file.load import referenced_files

    chosen, output = Choice(**choice), session.output
    with session.claim(RENDER) as folder:
        if is_bare:
            scene_file = remove_pictures(scene_file, size)
        scene, views = choose_views(session.build(scene_file), chosen)
        if folder is not None:
            if chosen.movie is not None:
                require_free_files([chosen.movie], may_exist=session.overwrite)
                require_movie(chosen.movie, views, output)
            folder.clear([scene_file.path, *referenced_files(scene_file)])
        return render_to_folder(scene, views, output, chosen)


@command(
    "SCENE",
    "output overwrite iterations resume preview_every frames shared exported up dtype report",
    is_shared=True,
)
def optimize(
    session: Session,
    source: Path,
    iterations: str | None,
    preview_every: int | None,
    **of_film: Any,
) -> None:
    """Reconstruct what SCENE asks for from its views' images, of a film frame after frame."""
    from ddrecon.run.result import RESULT

    of_run = (source.parent if source.name == RESULT else source) / "scene.yaml"
    if of_run.is_file() and of_run.with_name(RESULT).is_file():
        raise UsageError(
            f"{source}: a finished run leaves nothing to optimize; name its scene, {of_run}, "
            "and another folder or --resume --iterations N"
        )
    if of_film["up"] is not None and of_film["exported"] is None:
        raise click.UsageError("--up turns what --export writes: say --export as well")
    if iterations is not None:
        typed = f"--iterations {iterations}"
        session = session.with_override(f"optimize.iterations={iterations}", typed)
    scene_file = session.read(source)
    if scene_file.tree.frames is not None:
        session.show(*_optimize_film(session, scene_file, preview_every, **of_film))
        return
    for name, option in {"frames": "frames", "shared": "shared", "exported": "export"}.items():
        if of_film[name] is not None:
            raise click.UsageError(f"--{option} is for films: SCENE has no section frames")
    import torch

    from ddrecon.diffusion.solve import name_kernels
    from ddrecon.io.files.folders import RUN
    from ddrecon.progress import tell
    from ddrecon.run.job import work
    from ddrecon.run.run_folder import Run

    with session.claim(RUN) as folder:
        with tell("reading pictures and building the scene"):
            if scene_file.tree.diffusion.is_conservative_p1:
                dtype, place = getattr(torch, session.dtype), session.start()
                name_kernels(torch.empty(0, dtype=dtype, device=place))
            scene, environment = session.build(scene_file), session.environment()
        job = Run(scene, scene_file, environment, preview_every)
        outcome = work(job, folder, session.resume)
    session.show(*outcome)


def _optimize_film(
    session: Session,
    scene_file: SceneFile,
    preview_every: int | None,
    frames: str | None,
    shared: Path | None,
    exported: str | None,
    up: str | None,
) -> Outcome:
    """Reconstructs the `frames` of a film."""
    from ddrecon.film import Film, drive_film, open_film
    from ddrecon.io.files.folders import FILM
    from ddrecon.ranks import rank_count

    environment = session.environment()
    if rank_count() > 1:
        advice = "give each process an -o of its own, --frames and --shared"
        raise UsageError(f"torchrun: one process makes a film; {advice}")
    film = Film(scene_file, session.output, session.build, environment, preview_every)
    with session.claim(FILM) as folder:
        assert folder is not None
        numbers = open_film(film, folder, frames, shared, is_resumed=session.resume)
        return drive_film(film, folder, numbers, exported, up)


@command("RUN", "output overwrite experiments resume report", is_shared=True)
def uncertainty(session: Session, source: Path, experiments: int) -> None:
    """Say by experiments how sure RUN, the folder of a finished run, is of each cell and number."""
    from ddrecon.io.files.folders import UNCERTAINTY
    from ddrecon.run.job import work
    from ddrecon.run.result import require_no_film
    from ddrecon.run.run_folder import load_run
    from ddrecon.uncertainty.experiments import Uncertainty

    require_no_film(source)
    run = load_run(source, lambda dtype: session.build(session.read(source / "scene.yaml"), dtype))
    if run.level.train.volume.grid != run.problem.scene.volume.grid:
        raise UsageError(
            f"{source}: the run stopped before its last resolution; finish it with "
            "`ddrecon optimize --resume`"
        )
    job = Uncertainty(run, session.seed, experiments)
    with session.claim(UNCERTAINTY) as folder:
        outcome = work(job, folder, session.resume)
    session.show(*outcome)
