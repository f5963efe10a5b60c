"""Commands that say how far to trust the others, and of data files."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ddrecon.cli.command import SCENE_SUFFIXES, command
from ddrecon.errors import UsageError
from ddrecon.io.files.reading import guard_reading

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import torch

    from ddrecon.cli.session import Session
    from ddrecon.io.volumes.field import Facts, Fields
    from ddrecon.run.job import Outcome
    from ddrecon.scene import Scene


@command("SCENE", "parameters samples report")
def gradcheck(session: Session, source: Path, parameters: tuple[str, ...], samples: int) -> None:
    """Check tangent against adjoint against finite differences of the program, in float64."""
    scene = session.load(source)
    from ddrecon.validate.gradcheck import check_parameters, lines

    report = check_parameters(scene, parameters, samples, session.seed, session.progress)
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
        settings = output, paths, session.seed, session.progress
        report = compare_to_folder(tracer, compared, views, *settings)
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
            from ddrecon.validate.hard import hard_lines, run_cases

            report = run_cases(session.start(), session.progress)
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
    report = run_bench(scene, double, tracer, is_quick, session.progress)
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
    from ddrecon.uncertainty.experiments import volumes_in

    volumes = tuple(volume for path in source for volume in volumes_in(path) or [path])
    is_of_scene = kind not in WRITTEN or any(map(_is_scene, volumes))
    if is_of_scene and len(volumes) > 1:
        raise click.UsageError(f"one scene at a time is written as {kind}")
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
    from ddrecon.run.run_folder import fields_to_export

    report = describe_medium(*fields_to_export(scene)) if scene else describe(source)
    session.show(report, lines(report))


def _require_volumes(session: Session, sources: Sequence[Path]) -> None:
    """Raises FormatError for a source that is no scene and is not there, before imports.

    UsageError where nothing is a scene that `session` could override.
    """
    for path in sources:
        if path.suffix not in SCENE_SUFFIXES:
            with guard_reading(path):
                pass
    if session.overrides and not any(map(_is_scene, sources)):
        raise click.UsageError("-D changes a scene file; name one")


def _is_scene(source: Path) -> bool:
    """Whether `source` is a scene file or, perhaps, the folder of a run."""
    return source.is_dir() or source.suffix in SCENE_SUFFIXES
