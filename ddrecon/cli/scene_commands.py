"""Commands that take a scene: check, render, optimize.

torch is imported inside the commands, so that `--help` answers at once.
"""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ddrecon.cli.command import DTYPE, OUTPUT, OVERWRITE, REPORT, SCENE, SHARE, in_session
from ddrecon.cli.watch import SAVE_EVERY, watched

if TYPE_CHECKING:
    from ddrecon.cli.session import Session


class CountOrAuto(click.IntRange):
    """A whole number, or `auto`."""

    name = "integer or auto"

    def convert(
        self, value: Any, parameter: click.Parameter | None, context: click.Context | None
    ) -> Any:
        return value if value == "auto" else super().convert(value, parameter, context)


@click.command()
@SCENE
@DTYPE
@REPORT
@SHARE
@in_session
def check(session: Session, scene: Path) -> None:
    """Validate SCENE and print its grid, views, engine, memory and the physics it needs."""
    from ddrecon.cli.check import describe, lines
    from ddrecon.scene_file.dump import find_expert_keys

    scene_file = session.read(scene)
    expert = find_expert_keys(scene_file.tree)
    report = describe(session.build(scene_file), expert, session.shares_cells)
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
@SHARE
@DTYPE
@REPORT
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
    from ddrecon.io.files.atomic import write_json
    from ddrecon.io.files.folders import claim_folder
    from ddrecon.io.images.movies import require_mp4
    from ddrecon.ranks import is_first
    from ddrecon.reconstruct.shares import require_sharing
    from ddrecon.run.render_folder import (
        remove_targets,
        render_gradient_to_folder,
        render_lines,
        render_to_folder,
        require_variation,
        write_ring,
    )

    if count is None and has_mp4:
        raise click.UsageError("--mp4 is a movie of --ring N")
    if has_mp4:
        require_mp4()
    loaded = session.with_lights(lights).load(scene)
    require_sharing(loaded)
    views = session.pick_views(loaded, names)
    if lights or count is not None:
        loaded = remove_targets(loaded, views, count)
        views = list(loaded.views)
    if parameter is not None:
        require_variation(loaded, parameter)
    with claim_folder(output, may_exist=overwrite) if is_first() else nullcontext():
        settings = views, output, components
        if parameter is None:
            report = render_to_folder(loaded, *settings, session.progress)
        else:
            report = render_gradient_to_folder(loaded, *settings, parameter, session.progress)
        if not is_first():
            return
        if count is not None:
            report["ring"] = write_ring(views, output, has_mp4)
        write_json(output / "render.json", report)
    session.show(report, render_lines(report, output))


@click.command()
@SCENE
@OUTPUT
@OVERWRITE
@click.option(
    "--iterations",
    type=CountOrAuto(min=1),
    help="Total number of iterations, also after --resume; auto: the run ends by itself.",
)
@click.option("--resume", is_flag=True, help="Go on from the folder's checkpoint.")
@click.option(
    "--preview-every",
    type=click.IntRange(min=1),
    metavar="K",
    help="Write pictures every K iterations.",
)
@click.option(
    "--watch", "is_watched", is_flag=True, help="Also serve the run's page, as ddrecon watch does."
)
@click.option(
    "--uncertainty",
    "has_uncertainty",
    is_flag=True,
    help="Then also say how sure the result is, as ddrecon uncertainty does.",
)
@SHARE
@DTYPE
@REPORT
@in_session
def optimize(
    session: Session,
    scene: Path,
    output: Path,
    overwrite: bool,
    iterations: int | str | None,
    resume: bool,
    preview_every: int | None,
    is_watched: bool,
    has_uncertainty: bool,
) -> None:
    """Reconstruct what SCENE asks for from its views' images."""
    from ddrecon.cli.uncertainty import add_uncertainty, follow_added
    from ddrecon.ranks import is_first
    from ddrecon.reconstruct.shares import require_sharing
    from ddrecon.run.drive import drive_run, follow_run, open_run, summary_lines

    if iterations is not None:
        session = session.with_overrides(f"optimize.iterations={iterations}")
    scene_file = session.read(scene)
    built, environment = session.build(scene_file), session.environment()
    require_sharing(built)
    if not is_first():
        run = follow_run(built, scene_file, resume=resume, preview_every=preview_every)
        if has_uncertainty:
            follow_added(run)
        return
    with (
        open_run(built, scene_file, output, environment, may_exist=overwrite, resume=resume) as (
            run,
            folder,
        ),
        watched(output) if is_watched else nullcontext(),
    ):
        if is_watched:
            folder.save_often(SAVE_EVERY)
        is_last = not has_uncertainty
        summary = drive_run(run, folder, preview_every, session.is_quiet, is_last)
        lines = summary_lines(summary, output)
        if has_uncertainty:
            record, more = add_uncertainty(run, output, session.is_quiet)
            summary, lines = summary | {"uncertainty": record}, [*lines, *more]
    session.show(summary, lines)
