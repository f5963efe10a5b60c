"""The command `watch`, and the option of `optimize` that starts it beside a run.

torch is imported inside the command, so that `--help` answers at once.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ddrecon.cli.command import in_session

if TYPE_CHECKING:
    from ddrecon.cli.session import Session

PORT = 8765
SAVE_EVERY = 5.0
"""A run that is watched writes its state about every so many seconds."""
LAST_LOOK = 5.0
"""Seconds for which the finished page is still served."""


@click.command()
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--port", type=click.IntRange(0, 65535), default=PORT, show_default=True, help="0: a free one."
)
@in_session
def watch(session: Session, run: Path, port: int) -> None:
    """Serve the page of RUN, the folder of a run, on this machine alone, while the run goes on.

    Ctrl-C ends it.
    """
    from ddrecon.run.live import LiveRun
    from ddrecon.run.serve import HOST, serve_page

    live = LiveRun(run)
    with serve_page(live.page, port) as server:
        click.echo(f"http://{HOST}:{server.server_address[1]}/  (Ctrl-C ends)")
        server.serve_forever()


@contextmanager
def watched(folder: Path) -> Iterator[None]:
    """`watch` of `folder` in a process of its own, which ends a little after the block does."""
    command = [sys.executable, "-m", "ddrecon", "watch", str(folder), "--threads", "1"]
    process = subprocess.Popen(command, stdout=sys.stderr)
    try:
        yield
        time.sleep(LAST_LOOK)
    finally:
        process.terminate()
        process.wait()
