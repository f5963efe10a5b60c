"""Commands that take data files: export, info.

torch is imported inside the commands, so that `--help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ddrecon.cli.command import AS_JSON, in_session

if TYPE_CHECKING:
    from ddrecon.cli.session import Session


@click.command()
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


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@AS_JSON
@in_session
def info(session: Session, file: Path) -> None:
    """Print what is in FILE: a volume's box, cells and fields, or an image's size and values."""
    from ddrecon.io.info import describe, lines

    report = describe(file)
    session.show(report, lines(report))
