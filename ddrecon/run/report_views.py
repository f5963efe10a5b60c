"""The views of a run on its page: target against render, as they are displayed."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median
from typing import Any

import numpy as np
from torch import Tensor

from ddrecon.io.images import srgb
from ddrecon.io.images.webp import webp_of
from ddrecon.report.page import grid, pair, paragraph, table, unfolded
from ddrecon.report.pictures import find_white, pixels, shrink
from ddrecon.run.findings import Findings
from ddrecon.scene import View

SHOWN = 24
"""Views whose pictures are on the page; all are in the folder."""
PIXELS = 1_200_000
"""So many pixels all pictures of views have together, at most."""
LARGEST = 256
"""Pixels along the longer side of a picture, at most."""


def view_section(findings: Findings) -> list[str]:
    """Target and render of the first views, those held out first, and a table of all."""
    views = [view for view in findings.scene.views if view.image is not None]
    shown = sorted(views, key=lambda view: not view.is_test)[:SHOWN]
    white = median(find_white(pixels(_target(view))) for view in shown)
    most = min(LARGEST, int((PIXELS / (2 * len(shown))) ** 0.5))
    parts = [
        paragraph(
            f"The picture on the left, its render on the right, as displayed (sRGB; radiance "
            f"{white:.3g} is white). Move over a picture to shift the line between them; "
            "'difference' shows what differs in them, four times enlarged around gray."
        )
    ]
    for label, is_test in (("Held out", True), ("Trained on", False)):
        group = [view for view in shown if view.is_test == is_test]
        if group:
            figures = [_figure(findings, view, white, most) for view in group]
            parts.append(unfolded(f"{label}: {len(group)}", grid(figures), is_open=True))
    if len(views) > SHOWN:
        parts.append(paragraph(f"{len(views) - SHOWN} more views are in previews/."))
    return [*parts, unfolded("All views", _view_table(findings), is_open=False)]


def _target(view: View) -> Tensor:
    if view.image is None:
        raise ValueError(f"view {view.name} has no image")
    return view.image


def _figure(findings: Findings, view: View, white: float, most: int) -> str:
    target, render = (
        _displayed(image, white, most) for image in (_target(view), findings.images[view.name])
    )
    caption = f"{view.name}: {_quality_text(findings.quality[view.name])}"
    return pair(webp_of(target), webp_of(render), caption)


def _displayed(image: Tensor, white: float, most: int) -> np.ndarray:
    return srgb.encode_bytes(pixels(shrink(image, most)) / white)


def _view_table(findings: Findings) -> str:
    rows = []
    for view in findings.scene.views:
        height, width = view.camera.size
        split = "test" if view.is_test else "train"
        quality = findings.quality.get(view.name)
        told = (f"{quality['psnr']:.2f}", f"{quality['ssim']:.4f}") if quality else ("", "")
        rows.append((view.name, split, f"{width} x {height}", f"{view.weight:g}", *told))
    return table(["view", "split", "pixels", "weight", "PSNR [dB]", "SSIM"], rows)


def _quality_text(quality: Mapping[str, Any]) -> str:
    """PSNR and SSIM, and the exposure and offset that a held-out picture was compared with."""
    text = f"{quality['psnr']:.2f} dB, SSIM {quality['ssim']:.4f}"
    for key in ("exposure", "offset"):
        if f"fitted_{key}" in quality:
            values = ", ".join(f"{value:.3g}" for value in quality[f"fitted_{key}"])
            text += f", {key} {values} fitted to it"
    return text
