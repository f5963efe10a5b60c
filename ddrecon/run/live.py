"""The page of a run while it goes on: what its folder holds, made into the report's own sections.

The loss is that of `loss.csv`. Volume and views are those of the last checkpoint, rendered here,
beside what is asked for meanwhile.
"""

from __future__ import annotations

import signal
from contextlib import suppress
from multiprocessing import parent_process
from pathlib import Path
from socket import socket
from socketserver import BaseServer
from threading import Thread
from time import monotonic

import torch

from ddrecon.errors import DdreconError
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.report.page import page_text, section, side_by_side
from ddrecon.run.checkpoint import load_checkpoint, newest_checkpoint
from ddrecon.run.findings import Findings, given_fields
from ddrecon.run.loss_log import LossLog
from ddrecon.run.quality import render_run
from ddrecon.run.report import curves
from ddrecon.run.report_views import view_section
from ddrecon.run.report_volume import volume_section
from ddrecon.run.run_folder import require_run
from ddrecon.run.serve import serve_page
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import AUTO, Iterations

REPORT = "report.html"
SHARE = 0.25
"""Volume and views are made in this part of the time at most: the run needs the machine."""


class LiveRun:
    """A run in `folder`, which another process may be writing to.

    Raises UsageError where the folder holds no run.
    """

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
        return page_text(title, lead, sections, is_alive=True, is_live=True)

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
        start = monotonic()
        # What cannot be shown now may be with the next checkpoint.
        with suppress(DdreconError):
            self.sections = self._make_sections()
        self.next_make = monotonic() + (monotonic() - start) * (1 / SHARE - 1)

    def _make_sections(self) -> list[str]:
        """Volume and views as the last checkpoint has them."""
        state, _ = load_checkpoint(self.checkpoints)
        dtype = next(iter(state["parameters"].values()))["value"].dtype
        run = Reconstruction(load_scene(self.folder / "scene.yaml", dtype=dtype))
        run.restore(state)
        self.iterations = run.problem.settings.iterations
        with torch.no_grad():
            scene, light_field, images, quality = render_run(run)
        given = given_fields(run.problem.scene)
        findings = Findings(scene, given, light_field, images, quality, [], {}, {}, "")
        volume = section("Volume", volume_section(findings))
        return [volume, section("Views", *view_section(findings))]


def _written(file: Path | None) -> int:
    """When `file` was written [ns]; 0 where it is not there."""
    return file.stat().st_mtime_ns if file is not None and file.is_file() else 0


def serve_run(folder: Path, listening: socket) -> None:
    """Serves the page of the run in `folder` until the process ends that has started this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is meant for the run
    torch.set_num_threads(1)
    with serve_page(LiveRun(folder).page, listening) as server:
        Thread(target=_end_with_parent, args=(server,), daemon=True).start()
        server.serve_forever()


def _end_with_parent(server: BaseServer) -> None:
    if (parent := parent_process()) is not None:
        parent.join()
        server.shutdown()
