"""The report of a finished reconstruction: `report.html`, curves, pictures and tables in one file."""

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
from ddrecon.variables.values import VOLUME, value_of

SHOWN = 12
"""Views whose pictures are in the report; all are in the folder."""
LARGEST = 256
"""Pixels along the longer side of a picture in the report, at most."""
FRAMES, FRAME = 12, 96
"""Pictures of the turntable, and pixels along their longer side, at most."""


@dataclass(frozen=True)
class Findings:
    """What a report is made of: the `scene` as found, its `images` and PSNR of views with a target,
    the log, and plain values.
    """

    scene: Scene
    light_field: LightField
    images: Mapping[str, Tensor]
    quality: Mapping[str, Mapping[str, Any]]
    rows: Sequence[Row]
    summary: Mapping[str, Any]
    environment: Mapping[str, Any]
    settings: str


def write_run_report(path: Path, found: Findings) -> None:
    """Writes the report of what was `found` to `path`."""
    grid = found.scene.volume.grid
    cells = " x ".join(str(count) for count in reversed(grid.shape))
    test = (
        ""
        if found.summary["test_psnr"] is None
        else f", {found.summary['test_psnr']:.2f} dB of those held out"
    )
    lead = (
        f"{cells} cells, {found.summary['iterations']} iterations in {found.summary['seconds']:.1f} s. "
        f"PSNR {found.summary['psnr']:.2f} dB of the views seen last{test}."
    )
    sections = [
        section("Loss", side_by_side(*_curves(found.rows))),
        section("Views", *_compare(found), _view_table(found)),
        section("Volumes", *_volumes(found.scene)),
        section("Turntable", _turntable(found)),
        section("Timings", _timings(found.rows)),
        section(
            "Physics",
            paragraph("What this scene needed, and so was computed:"),
            items(needed_terms(found.scene)),
        ),
        section("Settings", fold("scene.yaml, all defaults filled in", found.settings)),
        section(
            "Versions",
            table(["", ""], [(key, _shown(value)) for key, value in found.environment.items()]),
        ),
    ]
    write_page(path, f"ddrecon: {path.absolute().parent.name}", lead, sections)


def _curves(rows: Sequence[Row]) -> list[str]:
    """Loss and PSNR by iteration."""
    quality = {"seen": [(float(row.iteration), row.psnr) for row in rows]}
    tests = [(float(row.iteration), row.test_psnr) for row in rows if row.test_psnr is not None]
    loss = draw_curve(
        "loss",
        {"": [(float(row.iteration), row.loss) for row in rows]},
        "iteration",
        is_logarithmic=True,
    )
    return [
        loss,
        draw_curve("PSNR [dB]", quality | ({"held out": tests} if tests else {}), "iteration"),
    ]


def _compare(found: Findings) -> list[str]:
    """Target, render and difference of the first views, those held out before the others."""
    views = sorted(
        (view for view in found.scene.views if view.name in found.images),
        key=lambda view: not view.is_test,
    )
    parts = [
        paragraph(
            "Target, render, and their difference four times enlarged around gray; the target's brightest pixels are just white."
        )
    ]
    parts.append(
        side_by_side(
            *(
                _comparison(view, found.images[view.name], found.quality[view.name])
                for view in views[:SHOWN]
            )
        )
    )
    if len(views) > SHOWN:
        parts.append(paragraph(f"{len(views) - SHOWN} more views are in previews/."))
    return parts


def _comparison(view: View, image: Tensor, quality: Mapping[str, Any]) -> str:
    target = image if view.image is None else view.image
    shown = comparison(shrink(target, LARGEST), shrink(image, LARGEST))
    return picture(png_of(shown), f"{view.name} ({quality['split']}): {quality['psnr']:.2f} dB")


def _view_table(found: Findings) -> str:
    rows = []
    for view in found.scene.views:
        height, width = view.camera.size
        quality = found.quality.get(view.name, {})
        decibels = f"{quality['psnr']:.2f}" if quality else ""
        rows.append(
            (
                view.name,
                "test" if view.is_test else "train",
                f"{width} x {height}",
                f"{view.weight:g}",
                decibels,
            )
        )
    return table(["view", "split", "pixels", "weight", "PSNR [dB]"], rows)


def _volumes(scene: Scene) -> list[str]:
    """Slices and projections of every field."""
    parts = [
        paragraph(
            "Across z, x and y from left to right; y, or z, is up. The largest value is white."
        )
    ]
    for name in VOLUME:
        value = value_of(scene, name)
        if value.ndim >= 3:
            top = float(value.max())
            shown = [("middle slices", slices(value)), ("means along the axes", projections(value))]
            captions = [
                f"{name}, {what} (the largest value of a cell is {top:.4g})" for what, _ in shown
            ]
            parts.append(
                side_by_side(
                    *(
                        picture(png_of(array), caption)
                        for caption, (_, array) in zip(captions, shown, strict=True)
                    )
                )
            )
    return parts


def _turntable(found: Findings) -> str:
    first = found.scene.views[0]
    small = View(first.name, first.camera.resize(-(-max(first.camera.size) // FRAME)))
    with torch.no_grad():
        views = place_turntable(found.scene, small, FRAMES)
        images = [pixels(view_image(found.light_field, found.scene, view.camera)) for view in views]
    white = max(map(find_white, images))
    animation = animation_of(encode_frames(images, white))
    caption = f"Once around the upright axis, from {first.name}; radiance {white:.3g} is white. Larger: ddrecon render RUN --ring 60"
    return picture(animation, caption, 300)


def _timings(rows: Sequence[Row]) -> str:
    """What an iteration took at each resolution."""
    stages: dict[int, list[tuple[Row, float]]] = {}
    for row, before in zip(rows, [0.0, *(row.seconds for row in rows)], strict=False):
        stages.setdefault(row.cells, []).append((row, row.seconds - before))
    lines = []
    for cells, timed in stages.items():
        solves = [
            mean(getattr(row, name) for row, _ in timed)
            for name in ("forward_iterations", "adjoint_iterations")
        ]
        seconds = [taken for _, taken in timed]
        lines.append(
            (
                f"{cells:,}",
                len(timed),
                f"{median(seconds):.3f}",
                f"{sum(seconds):.1f}",
                *(f"{count:.1f}" for count in solves),
            )
        )
    return table(
        [
            "cells",
            "iterations",
            "seconds each (median)",
            "seconds",
            "forward solve, iterations",
            "adjoint solve, iterations",
        ],
        lines,
    )


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
