"""The command `uncertainty`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ddrecon.cli.command import OUTPUT, OVERWRITE, REPORT, in_session
from ddrecon.errors import UsageError

if TYPE_CHECKING:
    import torch

    from ddrecon.cli.session import Session
    from ddrecon.scene import Scene


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@OUTPUT
@OVERWRITE
@click.option(
    "--samples",
    type=click.IntRange(min=2),
    default=16,
    show_default=True,
    metavar="N",
    help="Samples of the posterior in all, also after --resume.",
)
@click.option(
    "--noise",
    "read",
    type=click.FloatRange(min=0, min_open=True),
    metavar="X",
    help="Standard deviation of pictures, in radiance. Left out: as the scene says, or by what the "
    "reconstruction leaves.",
)
@click.option(
    "--tolerance",
    type=click.FloatRange(min=0, max=1, min_open=True),
    help="What a sample may lack. Left out: 0.5, and 0.01 where single numbers are optimized.",
)
@click.option("--keep-samples", "has_samples", is_flag=True, help="Also write each sample.")
@click.option(
    "--next-view",
    type=click.Choice(["ring", "lights"]),
    help="Which picture would tell most? Rank twelve by the first camera: turned around the volume "
    "(ring), or in directional lights that are (lights).",
)
@click.option("--resume", is_flag=True, help="Go on after the folder's last sample.")
@REPORT
@in_session
def uncertainty(
    session: Session,
    run: Path,
    output: Path,
    overwrite: bool,
    samples: int,
    read: float | None,
    tolerance: float | None,
    has_samples: bool,
    next_view: str | None,
    resume: bool,
) -> None:
    """Say how sure RUN is, the folder of a finished run: which cells its pictures tell, and which
    they do not.
    """
    from ddrecon.io.files.folders import claim_folder
    from ddrecon.pictures.noise import Noise
    from ddrecon.ranks import is_first
    from ddrecon.run.run_folder import load_run
    from ddrecon.uncertainty.drive import Request, drive_uncertainty, follow_uncertainty
    from ddrecon.uncertainty.folder import uncertainty_lines
    from ddrecon.uncertainty.next_view import FEWEST

    if next_view and samples < FEWEST:
        raise click.UsageError(f"--next-view takes at least {FEWEST} samples; found {samples}")
    if output.resolve() == run.resolve():
        raise click.UsageError("-o names the run itself; name another folder")

    def build(dtype: torch.dtype) -> Scene:
        return session.build(session.read(run / "scene.yaml"), dtype)

    taken = load_run(run, build)
    if taken.stage + 1 < len(taken.problem.factors):
        raise UsageError(
            f"{run}: the run stopped before its last resolution; finish it with "
            "`ddrecon optimize --resume`"
        )
    noise = None if read is None else Noise(read, 0.0)
    request = Request(session.seed, noise, tolerance, next_view)
    if not is_first():
        follow_uncertainty(taken, samples, request)
        return
    with claim_folder(output, may_exist=overwrite or resume):
        choice = {"has_samples": has_samples, "resume": resume, "is_quiet": session.is_quiet}
        record = drive_uncertainty(taken, output, samples, request, **choice)
    session.show(record, uncertainty_lines(record, output))
