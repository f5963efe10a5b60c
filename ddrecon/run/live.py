"""The page of a run while it goes on: what its folder holds, made into the report's own sections.

The loss is that of `loss.csv`. Volume and views are those of the last checkpoint, rendered here,
beside what is asked for meanwhile. It is served on this machine's own address, for its own browsers
only.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock, Thread
from time import monotonic

from ddrecon.errors import DdreconError, UsageError
from ddrecon.report.page import ALIVE, page_text, section, side_by_side
from ddrecon.run.checkpoint import newest_checkpoint
from ddrecon.run.loss_log import LossLog
from ddrecon.run.quality import find_results
from ddrecon.run.report import curves, view_section, volume_section
from ddrecon.run.run_folder import load_run, require_run
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import AUTO, Iterations

HOST = "127.0.0.1"
PORT = 8765
"""Where a page is served if that is free, and nothing else is asked for."""
REPORT = "report.html"
SHARE = 0.25
"""Volume and views are made in this part of the time at most: the run needs the machine."""


class LiveRun:
    """A run in `folder`, which another process may write to; UsageError where there is none."""

    def __init__(self, folder: Path):
        self.folder, self.checkpoints = folder, require_run(folder)
        self.seen, self.sections = 0, ["", ""]
        self.iterations: Iterations = AUTO
        self.maker, self.next_make = Thread(), 0.0

    def page(self) -> str:
        """The run's report where it is finished, else the page of what there is."""
        report = self.folder / REPORT
        if self._is_finished():
            return report.read_text(encoding="utf-8")
        rows = LossLog(self.folder / "loss.csv").rows()
        self._follow()
        volume, views = self.sections
        lead = "just begun"
        if rows:
            last = rows[-1]
            total = "" if self.iterations == AUTO else f" of {self.iterations}"
            lead = (
                f"iteration {last.iteration}{total} after {last.seconds:.0f} s, "
                f"PSNR {last.psnr:.2f} dB of views trained on"
            )
        loss = section("Loss", side_by_side(*curves(rows))) if rows else ""
        sections = [volume, loss, views]
        title = f"ddrecon: {self.folder.absolute().name}"
        return page_text(title, lead, sections, is_alive=True, state=ALIVE)

    def _is_finished(self) -> bool:
        """Whether the report was written after the run last began, or saved its state."""
        report = self.folder / REPORT
        began = _written(self.folder / "environment.json")
        saved = _written(newest_checkpoint(self.checkpoints))
        return 0 < max(began, saved) <= _written(report)

    def _follow(self) -> None:
        """Has volume and views made anew if there is a new checkpoint; waits only for the first."""
        written = _written(newest_checkpoint(self.checkpoints))
        if written == self.seen or self.maker.is_alive() or monotonic() < self.next_make:
            return
        is_first, self.seen = self.seen == 0, written
        self.maker = Thread(target=self._remake, daemon=True)
        self.maker.start()
        if is_first:
            self.maker.join()

    def _remake(self) -> None:
        start, path = monotonic(), self.folder / "scene.yaml"
        # What cannot be shown now may be with the next checkpoint.
        with suppress(DdreconError):
            run = load_run(self.folder, lambda dtype: load_scene(path, dtype=dtype))
            self.iterations, found = run.problem.settings.iterations, find_results(run)
            volume = section("Volume", volume_section(found, {}))
            self.sections = [volume, section("Views", *view_section(found))]
        self.next_make = monotonic() + (monotonic() - start) * (1 / SHARE - 1)


def _written(file: Path | None) -> int:
    """When `file` was written [ns]; 0 where it is not there."""
    return file.stat().st_mtime_ns if file is not None and file.is_file() else 0


class _Server(ThreadingHTTPServer):
    allow_reuse_port = False  # some Pythons would give away one that is taken


def serve_page(page: Callable[[], str], port: int | None) -> ThreadingHTTPServer:
    """A server of `page()`, made anew for each request, at `port` of localhost.

    None: at PORT, or a free one if it is taken. Raises UsageError where `port` is taken.
    """
    lock = Lock()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            # A site elsewhere may give its own name this address, to read what is here.
            name = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
            if self.path != "/" or name not in (HOST, "localhost"):
                self.send_error(404)
                return
            with lock:
                content = page().encode("utf-8")
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Requests are not logged."""

    if port is None:
        with suppress(OSError):
            return _Server((HOST, PORT), Handler)
    try:
        return _Server((HOST, port or 0), Handler)
    except OSError as error:
        reason = error.strerror or error
        raise UsageError(f"--port {port}: {reason}; leave it out for a free one") from error
