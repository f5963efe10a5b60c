"""Commands that take data files: export, import, info."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ddrecon.cli.command import REPORT, SCENE_SUFFIXES, UP, in_session
from ddrecon.errors import UsageError
from ddrecon.io.files.reading import guard_reading

if TYPE_CHECKING:
    from ddrecon.cli.session import Session
    from ddrecon.io.volumes.field import Facts, Fields


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
@UP
@in_session
def export(
    session: Session, sources: tuple[Path, ...], output: Path, overwrite: bool, up: str | None
) -> None:
    """Write SCENE for Mitsuba 3 (FILE.xml, and its volumes beside it), its cameras (.json, as
    NeRF's transforms.json), or all fields of SCENE, or of VOLUMEs, in the format of FILE's suffix.

    SCENE is a scene file or the folder of a finished run; a folder of `ddrecon uncertainty` counts
    as its volumes.
    """
    scene_file = session.read(sources[0]) if sources[0].suffix in SCENE_SUFFIXES else None
    _require_volumes(session, sources)
    from ddrecon.io.files.folders import require_free_files
    from ddrecon.run.result import require_no_film

    for source in sources:
        sequence = f"optimize {source}/scene.yaml -o {source} --resume --export vdb"
        require_no_film(source, f"; `ddrecon {sequence}` writes the volumes of all")
    from ddrecon.io.volumes.table import WRITTEN, read_together, turn_up, write_fields

    kind, suffixes = output.suffix.lower(), (".xml", ".json", *WRITTEN)
    if kind not in suffixes:
        raise UsageError(f"-o {output}: unknown format {kind!r}; known: {', '.join(suffixes)}")
    from ddrecon.reference.exchange import export_scene
    from ddrecon.run.exported import LENGTHS, fields_to_export
    from ddrecon.scene_file.camera_files import export_transforms
    from ddrecon.uncertainty.folder import volumes_in

    sources = tuple(path for source in sources for path in volumes_in(source) or [source])
    is_of_scene = kind not in WRITTEN or any(map(_is_scene, sources))
    if is_of_scene and len(sources) > 1:
        raise click.UsageError(f"one scene at a time is written as {kind}")
    if kind not in WRITTEN and up:
        raise click.UsageError(f"--up {up} turns volumes only")
    constants: Fields = {}
    upright = "y"
    if not is_of_scene:
        fields, bounds = read_together(sources)
    else:
        scene_file = scene_file or session.read(sources[0])
        scene, upright = session.build(scene_file), scene_file.tree.volume.up
        if kind == ".xml":
            written = export_scene(scene, output, may_exist=overwrite)
        elif kind == ".json":
            written = export_transforms(scene, scene_file, output, may_exist=overwrite)
        else:
            fields, constants, bounds = fields_to_export(scene)
    if kind in WRITTEN:
        written = [output]
        require_free_files(written, may_exist=overwrite)
        facts: Facts = {**constants, "units": LENGTHS} if is_of_scene else {}
        write_fields(output, *turn_up(fields, bounds, upright, up or upright), facts)
    if constants:
        rest = ", metadata" if kind == ".vdb" else ", not written"
        numbers = ", ".join(
            " ".join([name, *(f"{number:.6g}" for number in value.flatten().tolist())])
            for name, value in constants.items()
        )
        click.echo(f"fields: {', '.join(fields)}; the same everywhere{rest}: {numbers}")
    click.echo(f"written: {', '.join(map(str, written))}")


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


@click.command("import")
@click.argument("source", type=click.Path(path_type=Path), metavar="FILE.xml")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    metavar="SCENE.yaml",
    help="The scene file; its volume and its sky go beside it.",
)
@click.option("--overwrite", is_flag=True, help="Replace files that are there.")
@in_session
def import_(session: Session, source: Path, output: Path, overwrite: bool) -> None:
    """Write a scene file of a Mitsuba 3 scene: a grid volume in a cube, its lights and cameras."""
    from ddrecon.reference.exchange import import_scene

    written = import_scene(source, output, may_exist=overwrite)
    click.echo(f"written: {', '.join(map(str, written))}")


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@REPORT
@in_session
def info(session: Session, file: Path) -> None:
    """Print what is in FILE: a volume's box, cells and fields, or an image's size and values.

    A scene file, or the folder of a finished run, counts as its volume.
    """
    _require_volumes(session, [file])
    scene = session.load(file) if _is_scene(file) else None
    from ddrecon.io.info import describe, describe_medium, lines
    from ddrecon.run.exported import fields_to_export

    report = describe_medium(*fields_to_export(scene)) if scene else describe(file)
    session.show(report, lines(report))
