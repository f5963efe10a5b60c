"""The command line: parse, call, print. Results go to stdout, progress and logs to stderr.

torch is imported inside the commands, after their scene is read: help, and what is wrong with a
scene file, are shown at once.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any
from warnings import warn

import click

from ddrecon import __version__
from ddrecon.cli.command import SCENE_SUFFIXES, command
from ddrecon.engine import engine_versions
from ddrecon.errors import DataWarning, DdreconError, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import torch

    from ddrecon.cli.session import Session
    from ddrecon.io.volumes.field import Facts, Fields
    from ddrecon.run.job import Outcome
    from ddrecon.scene import Scene
    from ddrecon.scene_file.load import SceneFile

DRIVERS = "/dev/nvidiactl", "/dev/dxg", "/dev/kfd"
"""Devices of which one exists where torch may see a GPU; else torch is not loaded to look."""


class Commands(click.Group):
    """Lets `--json` stand without a value: `--json` prints, `--json report.json` writes."""

    def parse_args(self, context: click.Context, args: list[str]) -> list[str]:
        words = [
            "--json=-" if word == "--json" and not after.endswith(".json") else word
            for word, after in pairwise([*args, ""])
        ]
        return super().parse_args(context, words)


def show_version(context: click.Context, parameter: click.Parameter, is_asked: bool) -> None:
    """Prints what a run's result may depend on, and ends the program."""
    if not is_asked or context.resilient_parsing:
        return
    try:
        engine, *packages = engine_versions().items()
    except DdreconError as error:
        click.echo(str(error), err=True)
        context.exit(error.exit_code)
    from importlib.metadata import version  # here, so that help answers at once

    brought = "".join(f" ({name} {number})" for name, number in packages)
    device = "cpu"
    if any(map(os.path.exists, DRIVERS)):
        import torch

        device = torch.cuda.get_device_name() if torch.cuda.is_available() else "cpu"
    click.echo(
        f"ddrecon {__version__}, Python {platform.python_version()}, "
        f"torch {version('torch')}, engine {engine[1]}{brought}, device {device}"
    )
    context.exit()


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=show_version,
    help="Show versions and the device, and exit.",
)
def main() -> None:
    """Density volumes from pictures of smoke and clouds, by differential diffusion."""


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
    """Reconstructs this rank's share of the `frames` of a film."""
    from ddrecon.film import Film, drive_film, open_film, share_out
    from ddrecon.io.files.folders import FILM
    from ddrecon.ranks import alone, from_first

    environment = session.environment()
    film = Film(scene_file, session.output, session.build, environment, preview_every)
    with session.claim(FILM) as folder:
        numbers = list[int]()
        if folder is not None:
            numbers = open_film(film, folder, frames, shared, is_resumed=session.resume)
        share = share_out(from_first(numbers))
        with alone():
            return drive_film(film, folder, share, exported, up)


@command("RUN", "output overwrite experiments resume report", is_shared=True)
def uncertainty(session: Session, source: Path, experiments: int) -> None:
    """Say by experiments how sure RUN, the folder of a finished run, is of each cell and number."""
    from ddrecon.io.files.folders import UNCERTAINTY
    from ddrecon.run.job import work
    from ddrecon.run.result import require_no_film
    from ddrecon.run.run_folder import load_run
    from ddrecon.uncertainty import Uncertainty

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


@command("SCENE", "parameters samples report")
def gradcheck(session: Session, source: Path, parameters: tuple[str, ...], samples: int) -> None:
    """Check tangent against adjoint against finite differences of the program, in float64."""
    scene = session.load(source)
    from ddrecon.validate.gradcheck import check_parameters, lines

    report = check_parameters(scene, parameters, samples, session.seed)
    session.show(report, lines(report))
    if not report["passed"]:
        sys.exit(1)


@command("SCENE", "output overwrite names paths is_only_traced dtype report")
def reference(
    session: Session, source: Path, names: tuple[str, ...], paths: int, is_only_traced: bool
) -> None:
    """Path-trace the views of SCENE by Mitsuba 3, and tell how far ours are from them."""
    scene_file = session.read(source)
    scene = session.build(scene_file)
    from ddrecon.io.files.atomic import write_json
    from ddrecon.io.files.folders import REFERENCE, claim_folder
    from ddrecon.reference.trace import compare_to_folder, open_tracer, reference_lines
    from ddrecon.scene_file.load import referenced_files

    views, output = (
        [scene.view(name) for name in dict.fromkeys(names)] or scene.views,
        session.output,
    )
    tracer = open_tracer(scene, views, threads=session.threads)
    with claim_folder(output, REFERENCE, overwrite=session.overwrite) as folder:
        folder.clear([source, *referenced_files(scene_file)])
        compared = None if is_only_traced else scene
        report = compare_to_folder(tracer, compared, views, output, paths, session.seed)
        report["environment"] = session.environment() | {"mitsuba": tracer.module.__version__}
        write_json(output / "reference.json", report)
    session.show(report, reference_lines(report))


@command("[SCENE]", "is_quick is_hard output? overwrite report")
def bench(session: Session, source: Path | None, is_quick: bool, is_hard: bool) -> None:
    """Measure speed against error on SCENE, or on a plume of ddrecon's own."""
    if session.overrides and source is None:
        raise click.UsageError("-D changes a scene file; name one")
    if is_hard and (source is not None or is_quick):
        raise click.UsageError("--hard has cases of its own: leave out SCENE and --quick")
    scene_file = None if source is None else session.read(source)
    from ddrecon.cli.session import NOWHERE
    from ddrecon.io.files.atomic import write_json
    from ddrecon.io.files.folders import BENCH

    with nullcontext() if session.output == NOWHERE else session.claim(BENCH) as folder:
        if folder is not None:
            folder.clear()
        if is_hard:
            from ddrecon.bench import hard_lines, run_cases

            report = run_cases(session.start())
            lines = hard_lines(report)
        else:
            load = None if scene_file is None else partial(session.build, scene_file)
            report, lines = _bench_speed(session, load, is_quick)
        if folder is not None:
            write_json(folder.path / ("hard.json" if is_hard else "bench.json"), report)
    session.show(report, lines)
    if not report.get("passed", True):
        sys.exit(1)


def _bench_speed(
    session: Session, load: Callable[[torch.dtype], Scene] | None, is_quick: bool
) -> Outcome:
    from ddrecon.bench import bench_lines, load_pair, run_bench
    from ddrecon.errors import MissingExtraError, SceneError
    from ddrecon.reference.trace import open_tracer

    scene, double = load_pair(load, session.start(), is_quick)
    if scene.volume.media is not None:
        raise click.UsageError("the derivative by the density is measured; name a scene of one")
    tracer = None
    try:
        tracer = open_tracer(scene, scene.views, threads=session.threads)
    except (MissingExtraError, SceneError) as error:
        click.echo(f"without path tracing: {error}", err=True)
    report = run_bench(scene, double, tracer, is_quick)
    return report | {"environment": session.environment()}, bench_lines(report)


@command("SCENE | VOLUME...", "file overwrite up", common="overrides debug")
def export(session: Session, source: tuple[Path, ...], file: Path, up: str | None) -> None:
    """Write SCENE for Mitsuba 3 (FILE.xml, and its volumes beside it), its cameras (.json, as
    NeRF's transforms.json), or all fields of SCENE, or of VOLUMEs, in the format of FILE's suffix.

    SCENE is a scene file or the folder of a finished run; a folder of `ddrecon uncertainty` counts
    as its volumes.
    """
    scene_file = session.read(source[0]) if source[0].suffix in SCENE_SUFFIXES else None
    _require_volumes(session, source)
    from ddrecon.io.files.folders import require_free_files
    from ddrecon.run.result import require_no_film

    for path in source:
        sequence = f"optimize {path}/scene.yaml -o {path} --resume --export vdb"
        require_no_film(path, f"; `ddrecon {sequence}` writes the volumes of all")
    from ddrecon.io.volumes.table import WRITTEN, read_together, turn_up, write_fields

    kind, suffixes = file.suffix.lower(), (".xml", ".json", *WRITTEN)
    if kind not in suffixes:
        raise UsageError(f"-o {file}: unknown format {kind!r}; known: {', '.join(suffixes)}")
    from ddrecon.reference.exchange import export_scene
    from ddrecon.run.run_folder import LENGTHS, fields_to_export
    from ddrecon.scene_file.camera_files import export_transforms
    from ddrecon.uncertainty import volumes_in

    volumes = tuple(volume for path in source for volume in volumes_in(path) or [path])
    is_of_scene = kind not in WRITTEN or any(map(_is_scene, volumes))
    if is_of_scene and len(volumes) > 1:
        raise click.UsageError(f"one scene at a time is written as {kind}")
    if kind not in WRITTEN and not _is_scene(volumes[0]):
        raise click.UsageError(f"{volumes[0]}: is no scene, and {kind} is written of one")
    if kind not in WRITTEN and up:
        raise click.UsageError(f"--up {up} turns volumes only")
    may_exist, upright, lines = session.overwrite, "y", list[str]()
    fields: Fields
    facts: Facts = {}
    if is_of_scene:
        scene_file = scene_file or session.read(source[0])
        scene, upright = session.build(scene_file), scene_file.tree.volume.up
    if kind == ".xml":
        written = export_scene(scene, file, may_exist=may_exist)
    elif kind == ".json" and scene_file is not None:
        written = export_transforms(scene, scene_file, file, may_exist=may_exist)
    else:
        written = [file]
        if is_of_scene:
            fields, constants, bounds = fields_to_export(scene)
            facts = {**constants, "units": LENGTHS}
            rest = ", metadata" if kind == ".vdb" else ", not written"
            numbers = ", ".join(
                " ".join([name, *(f"{number:.6g}" for number in value.flatten().tolist())])
                for name, value in constants.items()
            )
            lines = [f"fields: {', '.join(fields)}; the same everywhere{rest}: {numbers}"]
        else:
            fields, bounds = read_together(volumes)
        require_free_files(written, may_exist=may_exist)
        write_fields(file, *turn_up(fields, bounds, upright, up or upright), facts)
    session.show({}, [*lines, f"written: {', '.join(map(str, written))}"])


@command("FILE.xml", "file overwrite", common="debug")
def import_(session: Session, source: Path, file: Path) -> None:
    """Write a scene file of a Mitsuba 3 scene: a grid volume in a cube, its lights and cameras."""
    from ddrecon.reference.exchange import import_scene

    written = import_scene(source, file, may_exist=session.overwrite)
    session.show({}, [f"written: {', '.join(map(str, written))}"])


@command("FILE", "report", common="overrides debug")
def info(session: Session, source: Path) -> None:
    """Print what is in FILE: a volume's box, cells and fields, or an image's size and values.

    A scene file, or the folder of a finished run, counts as its volume.
    """
    _require_volumes(session, [source])
    scene = session.load(source) if _is_scene(source) else None
    from ddrecon.io.info import describe, describe_medium, lines

    if scene is None:
        report = describe(source)
    else:
        from ddrecon.run.run_folder import fields_to_export

        report = describe_medium(*fields_to_export(scene))
    session.show(report, lines(report))


def _require_volumes(session: Session, sources: Sequence[Path]) -> None:
    """Raises UsageError where nothing is a scene that `session` could override."""
    if session.overrides and not any(map(_is_scene, sources)):
        raise click.UsageError("-D changes a scene file; name one")


def _is_scene(source: Path) -> bool:
    """Whether `source` is a scene file or, perhaps, the folder of a run."""
    return source.is_dir() or source.suffix in SCENE_SUFFIXES


ALL = (check, render, balance, optimize, uncertainty, gradcheck, reference, bench, export, import_)
for listed in (*ALL, info):
    main.add_command(listed)
