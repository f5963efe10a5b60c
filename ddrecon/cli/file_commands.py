"""Commands that take data files: export, info.

torch is imported inside the commands, so that `--help` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ddrecon.cli.command import REPORT, SCENE_SUFFIXES, in_session
from ddrecon.errors import UsageError

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
@click.option(
    "--up",
    type=click.Choice(["y", "z"]),
    default="y",
    help="Which axis points up in FILE, a volume: y leaves the axes as they are; z is for programs "
    "such as Blender and Unreal.",
)
@in_session
def export(
    session: Session, sources: tuple[Path, ...], output: Path, overwrite: bool, up: str
) -> None:
    """Write SCENE for Mitsuba 3 (FILE.xml, and its volumes beside it), its cameras (.json, as
    NeRF's transforms.json), or all fields of SCENE, or of VOLUMEs, in the format of FILE's suffix.

    SCENE is a scene file or the folder of a finished run; a folder of `ddrecon uncertainty` counts
    as its volumes.
    """
    from ddrecon.io.volumes.table import FORMATS
    from ddrecon.uncertainty.folder import volumes_in

    sources = tuple(path for source in sources for path in volumes_in(source) or [source])
    kind, known = output.suffix.lower(), (".xml", ".json", *FORMATS)
    if kind not in known:
        raise UsageError(f"-o {output}: unknown format {kind!r}; known: {', '.join(known)}")
    has_scene = any(map(_is_scene, sources))
    if (has_scene or kind in (".xml", ".json")) and len(sources) > 1:
        raise click.UsageError(f"one scene at a time is written as {kind}")
    if kind in (".xml", ".json") and up == "z":
        raise click.UsageError("--up z turns volumes only")
    if kind == ".xml":
        from ddrecon.reference.export import export_scene

        written = export_scene(session.load(sources[0]), output, may_exist=overwrite)
    elif kind == ".json":
        from ddrecon.scene_file.transforms import export_transforms

        scene_file = session.read(sources[0])
        written = export_transforms(
            session.build(scene_file), scene_file, output, may_exist=overwrite
        )
    else:
        _export_fields(session, sources, output, overwrite, has_scene, up)
        written = [output]
    click.echo(f"written: {', '.join(map(str, written))}")


def _export_fields(
    session: Session,
    sources: tuple[Path, ...],
    output: Path,
    overwrite: bool,
    is_scene: bool,
    up: str,
) -> None:
    """Writes the fields of a scene, or of all volumes `sources`, to `output`."""
    from ddrecon.io.files.folders import require_free_files
    from ddrecon.io.volumes.convert import raise_z, read_together
    from ddrecon.io.volumes.table import keeps_constants, write_fields
    from ddrecon.scene_file.export_fields import fields_of

    require_free_files([output], may_exist=overwrite)
    if is_scene:
        fields, constants, bounds = fields_of(session.load(sources[0]))
    else:
        (fields, bounds), constants = read_together(sources), {}
    if up == "z":
        fields, bounds = raise_z(fields, bounds)
    write_fields(output, fields, bounds, constants)
    if constants:
        numbers = ", ".join(f"{name} {_words(value)}" for name, value in constants.items())
        place = (
            "in its metadata" if keeps_constants(output) else "which the format has no place for"
        )
        click.echo(f"fields: {', '.join(fields)}; the same everywhere, {place}: {numbers}")


def _words(value: Any) -> str:
    return " ".join(f"{number:.6g}" for number in value.flatten().tolist())


def _is_scene(source: Path) -> bool:
    """Whether `source` is a scene file or, perhaps, the folder of a run."""
    return source.is_dir() or source.suffix in SCENE_SUFFIXES


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@REPORT
@in_session
def info(session: Session, file: Path) -> None:
    """Print what is in FILE: a volume's box, cells and fields, or an image's size and values.

    Of a scene file or the folder of a finished run, it is its volume.
    """
    from ddrecon.io.info import describe, describe_medium, lines
    from ddrecon.scene_file.export_fields import fields_of

    report = describe_medium(*fields_of(session.load(file))) if _is_scene(file) else describe(file)
    session.show(report, lines(report))
