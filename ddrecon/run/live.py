"""The page of a run while it goes on: what its folder holds, made into the report's own sections.

The loss is that of `loss.csv`; volume and views are those of the last checkpoint, rendered here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ddrecon.errors import UsageError
from ddrecon.reconstruct.loop import Reconstruction
from ddrecon.report.page import page_text, section, side_by_side
from ddrecon.run.checkpoint import LAST, read_state
from ddrecon.run.findings import Findings, given_fields, solve
from ddrecon.run.loss_log import LossLog
from ddrecon.run.quality import render_views
from ddrecon.run.report import curves
from ddrecon.run.report_views import view_section
from ddrecon.run.report_volume import volume_section
from ddrecon.run.run_folder import CHECKPOINTS
from ddrecon.scene_file.build import load_scene

REPORT = "report.html"


class LiveRun:
    """A run in `folder`, which another process may be writing to.

    Raises UsageError where the folder holds no run.
    """

    def __init__(self, folder: Path):
        self.folder, self.checkpoint = folder, folder / CHECKPOINTS / LAST
        if not (folder / "scene.yaml").is_file() or not self.checkpoint.is_file():
            raise UsageError(f"{folder}: holds no run, as `ddrecon optimize -o` makes it")
        self.seen, self.sections = 0, ["", ""]

    def page(self) -> str:
        """The run's report where it is finished, else the page of what there is."""
        report = self.folder / REPORT
        if self._is_finished():
            return report.read_text(encoding="utf-8")
        rows = LossLog(self.folder / "loss.csv").rows()
        written = self.checkpoint.stat().st_mtime_ns
        if written != self.seen:
            self.seen, self.sections = written, self._make_sections()
        volume, views = self.sections
        lead = "just begun"
        if rows:
            lead = f"iteration {rows[-1].iteration}, PSNR {rows[-1].psnr:.2f} dB"
        loss = section("Loss", side_by_side(*curves(rows))) if rows else ""
        sections = [volume, loss, views]
        title = f"ddrecon: {self.folder.absolute().name}"
        return page_text(title, lead, sections, is_alive=True, is_live=True)

    def _is_finished(self) -> bool:
        """Whether the report was written after the run last saved its state."""
        report = self.folder / REPORT
        return report.is_file() and report.stat().st_mtime_ns >= self.checkpoint.stat().st_mtime_ns

    def _make_sections(self) -> list[str]:
        """Volume and views as the last checkpoint has them."""
        state = read_state(self.checkpoint)
        dtype = next(iter(state["parameters"].values()))["value"].dtype
        run = Reconstruction(load_scene(self.folder / "scene.yaml", dtype=dtype))
        run.restore(state)
        with torch.no_grad():
            scene = run.current_scene()
            light_field = solve(scene)
            images, quality = render_views(run, scene, light_field)
        summary: dict[str, Any] = {}
        findings = Findings(
            scene,
            given_fields(run.scene),
            light_field,
            images,
            quality,
            [],
            summary,
            {},
            "",
        )
        volume = section("Volume", volume_section(findings))
        return [volume, section("Views", *view_section(findings))]
