"""Commands that say how far to trust the others: gradcheck, reference, bench."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ddrecon.cli.command import DTYPE, OUTPUT, OVERWRITE, REPORT, SCENE, in_session

if TYPE_CHECKING:
    from ddrecon.cli.session import Session
    from ddrecon.scene_file.load import SceneFile


@click.command()
@SCENE
@click.option(
    "--parameter",
    "names",
    multiple=True,
    metavar="NAME",
    help="Check only this parameter; repeatable.",
)
@click.option(
    "--samples",
    type=click.IntRange(min=2),
    default=8,
    show_default=True,
    help="Cells checked one by one.",
)
@REPORT
@in_session
def gradcheck(session: Session, scene: Path, names: tuple[str, ...], samples: int) -> None:
    """Check tangent against adjoint against finite differences of the program, in float64."""
    loaded = session.load(scene)
    from ddrecon.validate.gradcheck import check_parameters, describe, table

    checks = check_parameters(loaded, names, samples, session.seed, session.progress)
    session.show(describe(checks), table(checks))
    if not all(check.has_passed for check in checks):
        sys.exit(1)


@click.command()
@SCENE
@OUTPUT
@OVERWRITE
@click.option(
    "--view", "names", multiple=True, metavar="NAME", help="Trace only this view; repeatable."
)
@click.option(
    "--spp",
    "samples",
    type=click.IntRange(min=4),
    default=256,
    show_default=True,
    metavar="N",
    help="Paths a pixel.",
)
@click.option(
    "--views",
    "is_only_traced",
    is_flag=True,
    help="Write the path-traced images alone, as NAME.*: targets for experiments.",
)
@DTYPE
@REPORT
@in_session
def reference(
    session: Session,
    scene: Path,
    output: Path,
    overwrite: bool,
    names: tuple[str, ...],
    samples: int,
    is_only_traced: bool,
) -> None:
    """Path-trace the views of SCENE by Mitsuba 3, and tell how far ours are from them."""
    scene_file = session.read(scene)
    loaded = session.build(scene_file)
    from ddrecon.io.files.atomic import write_json
    from ddrecon.io.files.folders import REFERENCE, claim_folder
    from ddrecon.reference.trace import compare_to_folder, open_tracer, reference_lines
    from ddrecon.scene_file.load import referenced_files

    views = [loaded.view(name) for name in dict.fromkeys(names)] or loaded.views
    tracer = open_tracer(loaded, views, threads=session.threads)
    with claim_folder(output, REFERENCE, overwrite=overwrite) as folder:
        folder.clear([scene, *referenced_files(scene_file)])
        shown = None if is_only_traced else loaded
        settings = output, samples, session.seed, session.progress
        report = compare_to_folder(tracer, shown, views, *settings)
        report["environment"] = session.environment() | {"mitsuba": tracer.module.__version__}
        write_json(output / "reference.json", report)
    session.show(report, reference_lines(report, output))


@click.command()
@click.argument("scene", required=False, type=click.Path(path_type=Path))
@click.option(
    "--quick", "is_quick", is_flag=True, help="A small scene, or SCENE made coarser, measured once."
)
@click.option(
    "--hard",
    "is_hard",
    is_flag=True,
    help="Instead: numerical stability on hard cases, in float32 against float64.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Folder for the results: bench.json, or hard.json.",
)
@OVERWRITE
@REPORT
@in_session
def bench(
    session: Session,
    scene: Path | None,
    is_quick: bool,
    is_hard: bool,
    output: Path | None,
    overwrite: bool,
) -> None:
    """Measure speed against error on SCENE, or on a plume of ddrecon's own."""
    if session.overrides and scene is None:
        raise click.UsageError("-D changes a scene file; name one")
    if is_hard and (scene is not None or is_quick):
        raise click.UsageError("--hard has cases of its own: leave out SCENE and --quick")
    scene_file = None if scene is None else session.read(scene)
    from ddrecon.io.files.atomic import write_json
    from ddrecon.io.files.folders import BENCH, claim_folder
    from ddrecon.validate.hard import hard_lines, run_cases

    claim = nullcontext() if output is None else claim_folder(output, BENCH, overwrite=overwrite)
    with claim as folder:
        if folder is not None:
            folder.clear()
        if is_hard:
            report = run_cases(session.start(), session.progress)
            lines = hard_lines(report)
        else:
            report, lines = _bench_speed(session, scene_file, is_quick)
        if output is not None:
            write_json(output / ("hard.json" if is_hard else "bench.json"), report)
        session.show(report, lines)
        if is_hard and not report["passed"]:
            sys.exit(1)


def _bench_speed(
    session: Session, scene_file: SceneFile | None, is_quick: bool
) -> tuple[dict[str, Any], list[str]]:
    from ddrecon.bench import bench_lines, load_pair, run_bench
    from ddrecon.errors import MissingExtraError, SceneError
    from ddrecon.reference.trace import open_tracer

    load = None if scene_file is None else partial(session.build, scene_file)
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
