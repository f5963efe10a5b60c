"""The report of a finished reconstruction, `report.html`: curves, pictures and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median
from typing import Any

import torch
from torch import Tensor

from ddrecon.io.images.movies import animation_of, encode_frames
from ddrecon.io.images.table import png_of
from ddrecon.reconstruct.log import Row
from ddrecon.reconstruct.smoothing import smoothing_text
from ddrecon.renderer import LightField, view_image
from ddrecon.report.curve import draw_curve
from ddrecon.report.page import (
    fold,
    items,
    paragraph,
    picture,
    section,
    side_by_side,
    table,
    write_page,
)
from ddrecon.report.pictures import comparison, find_white, pixels, projections, shrink, slices
from ddrecon.scene import Scene, View
from ddrecon.terms import needed_terms
from ddrecon.turntable import place_turntable
from ddrecon.variables.kinds import FIELDS
from ddrecon.variables.values import value_of

SHOWN = 12
"""Views whose pictures are in the report; all are in the folder."""
LARGEST = 256
"""Pixels along the longer side of a picture in the report, at most."""
FRAMES, FRAME = 12, 96
"""Pictures of the turntable, and pixels along their longer side, at most."""

TIMING_HEAD = [
    "cells",
    "iterations",
    "seconds each (median)",
    "seconds",
    "forward solve, iterations",
    "adjoint solve, iterations",
]
"""The columns of the table of timings."""


@dataclass(frozen=True)
class Findings:
    """What a report is made of: the `scene` as found, `images` and PSNR by view, and the log."""

    scene: Scene
    light_field: LightField
    images: Mapping[str, Tensor]
    quality: Mapping[str, Mapping[str, Any]]
    rows: Sequence[Row]
    summary: Mapping[str, Any]
    environment: Mapping[str, Any]
    settings: str


def write_run_report(path: Path, findings: Findings) -> None:
    """Writes the report of `findings` to `path`."""
    scene, needs = findings.scene, "What this scene needed, and so was computed:"
    versions = [(key, _format(value)) for key, value in findings.environment.items()]
    sections = [
        section("Loss", side_by_side(*_curves(findings.rows))),
        section("Views", *_comparisons(findings), _view_table(findings)),
        section("Volumes", *_volumes(scene, findings.summary)),
        section("Turntable", _turntable(findings)),
        section("Timings", _timings(findings.rows)),
        section("Physics", paragraph(needs), items(needed_terms(scene))),
        section("Settings", fold("scene.yaml, all defaults filled in", findings.settings)),
        section("Versions", table(["", ""], versions)),
    ]
    write_page(path, f"ddrecon: {path.absolute().parent.name}", _lead(findings), sections)


def _lead(findings: Findings) -> str:
    """The sentence below the title."""
    cells = " x ".join(str(count) for count in reversed(findings.scene.volume.grid.shape))
    summary, test = findings.summary, ""
    if summary["test_psnr"] is not None:
        test = f", {summary['test_psnr']:.2f} dB of those held out, SSIM {summary['test_ssim']:.4f}"
    return (
        f"{cells} cells, {summary['iterations']} iterations in {summary['seconds']:.1f} s. "
        f"PSNR {summary['psnr']:.2f} dB of the views seen last{test}. "
        f"What is compared is {summary['compared']}, by the loss {summary['loss_function']}."
    )


def _curves(rows: Sequence[Row]) -> list[str]:
    """Loss and PSNR by iteration."""
    losses = {"": [(float(row.iteration), row.loss) for row in rows]}
    quality = {"seen": [(float(row.iteration), row.psnr) for row in rows]}
    tests = [(float(row.iteration), row.test_psnr) for row in rows if row.test_psnr is not None]
    if tests:
        quality["held out"] = tests
    return [
        draw_curve("loss", losses, "iteration", is_logarithmic=True),
        draw_curve("PSNR [dB]", quality, "iteration"),
    ]


def _comparisons(findings: Findings) -> list[str]:
    """Target, render and difference of the first views, those held out before the others."""
    views = [view for view in findings.scene.views if view.name in findings.images]
    views.sort(key=lambda view: not view.is_test)
    caption = (
        "Target, render, and their difference four times enlarged around gray; "
        "the target's brightest pixels are just white."
    )
    pictures = [
        _comparison(view, findings.images[view.name], findings.quality[view.name])
        for view in views[:SHOWN]
    ]
    parts = [paragraph(caption), side_by_side(*pictures)]
    if len(views) > SHOWN:
        parts.append(paragraph(f"{len(views) - SHOWN} more views are in previews/."))
    return parts


def _comparison(view: View, image: Tensor, quality: Mapping[str, Any]) -> str:
    target = image if view.image is None else view.image
    shown = comparison(shrink(target, LARGEST), shrink(image, LARGEST))
    return picture(png_of(shown), f"{view.name} ({quality['split']}): {_quality_text(quality)}")


def _quality_text(quality: Mapping[str, Any]) -> str:
    """PSNR and SSIM, and the exposure and offset that a held-out picture was compared with."""
    text = f"{quality['psnr']:.2f} dB, SSIM {quality['ssim']:.4f}"
    for key in ("exposure", "offset"):
        if f"fitted_{key}" in quality:
            values = ", ".join(f"{value:.3g}" for value in quality[f"fitted_{key}"])
            text += f", {key} {values} fitted to it"
    return text


def _view_table(findings: Findings) -> str:
    rows = []
    for view in findings.scene.views:
        height, width = view.camera.size
        split = "test" if view.is_test else "train"
        quality = findings.quality.get(view.name)
        told = (f"{quality['psnr']:.2f}", f"{quality['ssim']:.4f}") if quality else ("", "")
        rows.append((view.name, split, f"{width} x {height}", f"{view.weight:g}", *told))
    return table(["view", "split", "pixels", "weight", "PSNR [dB]", "SSIM"], rows)


def _left_out(summary: Mapping[str, Any]) -> str:
    return f"{100 * (1 - summary['support']['cells']):.3g}"


def _volumes(scene: Scene, summary: Mapping[str, Any]) -> list[str]:
    """Slices and projections of every field."""
    parts = [
        paragraph(
            "Across z, x and y from left to right; y, or z, is up. The largest value is white."
        )
    ]
    if "support" in summary:
        parts.append(paragraph(f"Left out by the support: {_left_out(summary)} % of the cells."))
    if "smoothing" in summary:
        parts.append(paragraph(smoothing_text(summary["smoothing"])))
    for name in FIELDS:
        value = value_of(scene, name)
        if value.ndim >= 3:
            largest = f"(the largest value of a cell is {float(value.max()):.4g})"
            cut = picture(png_of(slices(value)), f"{name}, middle slices {largest}")
            means = picture(png_of(projections(value)), f"{name}, means along the axes {largest}")
            parts.append(side_by_side(cut, means))
    return parts


def _turntable(findings: Findings) -> str:
    """A movie of FRAMES pictures once around the volume, from the first view."""
    first = findings.scene.views[0]
    small = View(first.name, first.camera.resize(-(-max(first.camera.size) // FRAME)))
    with torch.no_grad():
        images = [
            pixels(view_image(findings.light_field, findings.scene, view.camera))
            for view in place_turntable(findings.scene, small, FRAMES)
        ]
    white = max(map(find_white, images))
    caption = (
        f"Once around the upright axis, from {first.name}; radiance {white:.3g} is white. "
        "Larger: ddrecon render RUN --ring 60"
    )
    return picture(animation_of(encode_frames(images, white)), caption, 300)


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


def _format(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
