"""The command line: parse, call, print. Results go to stdout, progress and logs to stderr.

torch is imported inside the commands, so that `--help` answers at once.
"""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ddrecon.cli.command import (
    AS_JSON,
    DTYPE,
    OUTPUT,
    OVERWRITE,
    REPORT,
    SCENE,
    in_session,
    require_folder_of,
    show_version,
)

if TYPE_CHECKING:
    from ddrecon.cli.session import Session


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
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


@main.command()
@SCENE
@OUTPUT
@OVERWRITE
@click.option(
    "--view", "names", multiple=True, metavar="NAME", help="Render only this view; repeatable."
)
@click.option(
    "--components",
    is_flag=True,
    help="Also write reduced, single and multiple radiance, which sum to the image.",
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
    type=click.IntRange(min=2),
    metavar="N",
    help="N views around the volume instead, and ring.png of them.",
)
@click.option("--mp4", "has_mp4", is_flag=True, help="With --ring, also write ring.mp4.")
@DTYPE
@AS_JSON
@in_session
def render(
    session: Session,
    scene: Path,
    output: Path,
    overwrite: bool,
    names: tuple[str, ...],
    components: bool,
    parameter: str | None,
    lights: tuple[str, ...],
    count: int | None,
    has_mp4: bool,
) -> None:
    """Render the views of SCENE, a scene file or the folder of a finished run."""
    from ddrecon.io.files.folders import claim_folder
    from ddrecon.io.files.json_file import write_json
    from ddrecon.io.images.movies import require_mp4
    from ddrecon.run.render_folder import (
        render_gradient_to_folder,
        render_to_folder,
        require_variation,
        write_ring,
    )

    if count is None and has_mp4:
        raise click.UsageError("--mp4 is a movie of --ring N")
    if has_mp4:
        require_mp4()
    loaded = session.relit(lights).load(scene)
    views = session.chosen_views(loaded, names)
    if lights or count is not None:
        loaded, views = session.without_targets(loaded, views, count)
    if parameter is not None:
        require_variation(loaded, parameter)
    with claim_folder(output, may_exist=overwrite):
        settings = views, output, components
        if parameter is None:
            report = render_to_folder(loaded, *settings, session.progress)
        else:
            report = render_gradient_to_folder(loaded, *settings, parameter, session.progress)
        if count is not None:
            report["ring"] = write_ring(views, output, has_mp4)
        write_json(output / "render.json", report)
    session.show(report, session.render_lines(report, output))


@main.command()
@SCENE
@OUTPUT
@OVERWRITE
@click.option(
    "--iterations",
    type=click.IntRange(min=1),
    help="Total number of iterations, also after --resume.",
)
@click.option("--resume", is_flag=True, help="Go on from the folder's checkpoint.")
@click.option(
    "--preview-every",
    type=click.IntRange(min=1),
    metavar="K",
    help="Write pictures every K iterations.",
)
@click.option(
    "--tensorboard", "has_events", is_flag=True, help="Also write the loss log for TensorBoard."
)
@DTYPE
@AS_JSON
@in_session
def optimize(
    session: Session,
    scene: Path,
    output: Path,
    overwrite: bool,
    iterations: int | None,
    resume: bool,
    preview_every: int | None,
    has_events: bool,
) -> None:
    """Reconstruct what SCENE asks for from its views' images."""
    from ddrecon.run.drive import drive_run, open_run
    from ddrecon.run.events import require_tensorboard

    if has_events:
        require_tensorboard()
    if iterations is not None:
        session = session.overriding(f"optimize.iterations={iterations}")
    scene_file = session.read(scene)
    built, environment = session.build(scene_file), session.environment()
    with open_run(built, scene_file, output, environment, may_exist=overwrite, resume=resume) as (
        run,
        folder,
    ):
        summary = drive_run(run, folder, preview_every, session.is_quiet, has_events)
    session.show(summary, session.summary_lines(summary, output))


@main.command()
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
def gradcheck(
    session: Session, scene: Path, names: tuple[str, ...], samples: int, report: Path | None
) -> None:
    """Check tangent against adjoint against finite differences of the program, in float64."""
    from ddrecon.io.files.json_file import write_json
    from ddrecon.validate.gradcheck import check_parameters, describe

    require_folder_of(report)
    checks = check_parameters(session.load(scene), names, samples, session.seed, session.progress)
    click.echo("\n".join(line for check in checks for line in check.lines()))
    if report is not None:
        write_json(report, describe(checks))
    if not all(check.has_passed for check in checks):
        sys.exit(1)


@main.command()
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
    help="Folder for the results: bench.json, bench.png and report.html, or hard.json.",
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
    report: Path | None,
) -> None:
    """Measure speed against error on SCENE, or on a plume of ddrecon's own."""
    if session.overrides and scene is None:
        raise click.UsageError("-D changes a scene file; name one")
    if is_hard and (scene is not None or is_quick):
        raise click.UsageError("--hard has cases of its own: leave out SCENE and --quick")
    require_folder_of(report)
    from ddrecon.bench.run import bench_hard, bench_speed
    from ddrecon.io.files.folders import claim_folder

    with nullcontext() if output is None else claim_folder(output, may_exist=overwrite):
        has_passed = (
            bench_hard(session, output, report)
            if is_hard
            else bench_speed(session, scene, is_quick, output, report)
        )
    if not has_passed:
        sys.exit(1)


@main.command()
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
@AS_JSON
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
    from ddrecon.io.files.folders import claim_folder
    from ddrecon.reference.compare import compare_to_folder, trace_to_folder, write_reference_report
    from ddrecon.reference.trace import open_tracer

    loaded = session.load(scene)
    views = session.chosen_views(loaded, names)
    tracer = open_tracer(loaded, views, threads=session.threads)
    with claim_folder(output, may_exist=overwrite):
        settings = output, samples, session.seed, session.progress
        found = (
            trace_to_folder(tracer, views, *settings)
            if is_only_traced
            else compare_to_folder(tracer, loaded, views, *settings)
        )
        report = write_reference_report(output, found, session.environment())
    session.show(report, session.reference_lines(report, output))


@main.command()
@click.argument(
    "sources", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="SCENE | VOLUME..."
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    metavar="FILE",
    help="Where it goes.",
)
@click.option("--overwrite", is_flag=True, help="Replace files that are there.")
@in_session
def export(session: Session, sources: tuple[Path, ...], output: Path, overwrite: bool) -> None:
    """Write SCENE for Mitsuba 3 (FILE.xml, and its volumes beside it), its cameras (.json, as
    NeRF's transforms.json), or all fields of VOLUMEs in the format of FILE's suffix.
    """
    kind = output.suffix.lower()
    if kind in (".xml", ".json") and len(sources) > 1:
        raise click.UsageError(f"one scene at a time is written as {kind}")
    if kind == ".xml":
        from ddrecon.reference.export import export_scene

        written = export_scene(session.load(sources[0]), output, may_exist=overwrite)
    elif kind == ".json":
        from ddrecon.scene_file.export_transforms import export_transforms

        scene_file = session.read(sources[0])
        written = export_transforms(
            session.build(scene_file), scene_file, output, may_exist=overwrite
        )
    else:
        from ddrecon.io.volumes.convert import convert

        written = convert(sources, output, may_exist=overwrite)
    click.echo(f"written: {', '.join(map(str, written))}")


@main.command()
@click.argument("file", type=click.Path(path_type=Path))
@AS_JSON
@in_session
def info(session: Session, file: Path) -> None:
    """Print what is in FILE: a volume's box, cells and fields, or an image's size and values."""
    from ddrecon.io.info import describe, lines

    report = describe(file)
    session.show(report, lines(report))


@main.command()
@SCENE
@DTYPE
@AS_JSON
@in_session
def check(session: Session, scene: Path) -> None:
    """Validate SCENE and print its grid, views, memory and the physics it needs."""
    from ddrecon.cli.check import describe, lines

    report = describe(session.load(scene))
    session.show(report, lines(report))
