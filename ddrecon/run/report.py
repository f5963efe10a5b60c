"""The report of a finished reconstruction, `report.html`: curves, pictures and tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import mean, median

from ddrecon.engine import name_engines
from ddrecon.reconstruct.log import Row
from ddrecon.reconstruct.shares import has_slabs
from ddrecon.report.curve import draw_curve
from ddrecon.report.page import (
    fold,
    items,
    paragraph,
    section,
    side_by_side,
    table,
    versions,
    warnings,
    write_page,
)
from ddrecon.run.findings import Findings
from ddrecon.run.report_views import view_section
from ddrecon.run.report_volume import turntable, volume_section
from ddrecon.terms import engine_of_scene, needed_terms

TIMING_HEAD = [
    "cells",
    "iterations",
    "seconds each (median)",
    "seconds",
    "forward solve, iterations",
    "adjoint solve, iterations",
]
"""The columns of the table of timings."""


def write_run_report(path: Path, findings: Findings) -> None:
    """Writes the report of `findings` to `path`."""
    scene, needs = findings.scene, "What this scene needed, and so was computed:"
    engines = name_engines(engine_of_scene(scene, has_slabs(scene)))
    environment = {k: v for k, v in findings.environment.items() if k != "engines"}
    diagnoses = [diagnosis["text"] for diagnosis in findings.summary["diagnoses"]]
    sections = [
        *([warnings(diagnoses)] if diagnoses else []),
        section("Volume", volume_section(findings)),
        section("Loss", side_by_side(*curves(findings.rows))),
        section("Views", *view_section(findings)),
        section("Turntable", turntable(findings)),
        section("Timings", _timings(findings.rows)),
        section("Physics", paragraph(needs), items([*needed_terms(scene), f"engine {engines}"])),
        section("Settings", fold("scene.yaml, all defaults filled in", findings.settings)),
        section("Versions", versions(environment)),
    ]
    title = f"ddrecon: {path.absolute().parent.name}"
    write_page(path, title, _lead(findings), sections, is_alive=True)


def _lead(findings: Findings) -> str:
    """The sentence below the title."""
    cells = " x ".join(str(count) for count in reversed(findings.scene.volume.grid.shape))
    summary, test = findings.summary, ""
    if summary["test_psnr"] is not None:
        test = (
            f", {summary['test_psnr']:.2f} dB (SSIM {summary['test_ssim']:.4f}) of views held out"
        )
    return (
        f"{cells} cells, {summary['iterations']} iterations in {summary['seconds']:.1f} s. "
        f"PSNR {summary['psnr']:.2f} dB of views trained on{test}. "
        f"All of these compare {summary['compared']}; the loss is {summary['loss_function']}."
        f" It {summary['ended']['text']}."
    )


def curves(rows: Sequence[Row]) -> list[str]:
    """Loss and PSNR by iteration."""
    losses = {
        "images": [(float(row.iteration), row.data_loss) for row in rows],
        "penalties": [(float(row.iteration), row.penalty) for row in rows],
    }
    quality = {"trained on": [(float(row.iteration), row.psnr) for row in rows]}
    tests = [(float(row.iteration), row.test_psnr) for row in rows if row.test_psnr is not None]
    if tests:
        quality["held out"] = tests
    return [
        draw_curve("loss", losses, "iteration", is_logarithmic=True),
        draw_curve("PSNR [dB]", quality, "iteration"),
    ]


def _timings(rows: Sequence[Row]) -> str:
    """What an iteration took at each resolution."""
    stages: dict[int, list[tuple[Row, float]]] = {}
    for row, before in zip(rows, [0.0, *(row.seconds for row in rows)], strict=False):
        stages.setdefault(row.cells, []).append((row, row.seconds - before))
    lines = []
    for cells, timed in stages.items():
        seconds = [taken for _, taken in timed]
        solves = [
            mean(row.forward_iterations for row, _ in timed),
            mean(row.adjoint_iterations for row, _ in timed),
        ]
        times = f"{median(seconds):.3f}", f"{sum(seconds):.1f}"
        lines.append((f"{cells:,}", len(timed), *times, *(f"{count:.1f}" for count in solves)))
    return table(TIMING_HEAD, lines)
