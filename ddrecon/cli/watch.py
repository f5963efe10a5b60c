"""The command `watch`, and the option of `optimize` that starts it beside a run.

torch is imported inside the command, so that `--help` answers at once.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ddrecon.cli.command import in_session

if TYPE_CHECKING:
    from ddrecon.cli.session import Session

SAVE_EVERY = 5.0
"""A run that is watched writes its state about every so many seconds."""
LAST_LOOK = 5.0
"""Seconds for which the finished page is still served."""


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    show_default="8765, or a free one if that is taken",
    help="Where to serve it; 0 is a free one.",
)
@in_session
def watch(session: Session, run: Path, port: int | None) -> None:
    """Serve the page of RUN, the folder of a run, on this machine alone, while the run goes on.

    Ctrl-C ends it.
    """
    from ddrecon.run.live import LiveRun, listen, serve_page, url_of

    live = LiveRun(run)
    with listen(port) as listening, serve_page(live.page, listening) as server:
        click.echo(f"{url_of(listening)}  (Ctrl-C ends)")
        server.serve_forever()


@contextmanager
def watched(folder: Path) -> Iterator[None]:
    """The page of the run in `folder`, by a process of its own that ends soon after the block."""
    from ddrecon.run.live import listen, serve_run, url_of

    with listen(None) as listening:
        click.echo(f"{url_of(listening)} shows the run", err=True)
        process = get_context("spawn").Process(target=serve_run, args=(folder, listening))
        process.start()
    try:
        yield
        time.sleep(LAST_LOOK)
    finally:
        process.terminate()
        process.join()
