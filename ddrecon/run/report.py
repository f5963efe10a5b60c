"""The report of a finished reconstruction, `report.html`: curves, pictures and tables.

Target and render of a view stand side by side as they are displayed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from ddrecon.io.images.table import webp_of
from ddrecon.pictures import srgb
from ddrecon.reconstruct.frame import Row
from ddrecon.reconstruct.objective import target_of
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.report.curve import Plot, draw_curve
from ddrecon.report.page import write_page
from ddrecon.report.pictures import find_white, pixels, shrink
from ddrecon.report.volumes import Shown, describe_volume, describe_world, find_white_value
from ddrecon.run.quality import Findings, shift_between
from ddrecon.scene import Scene, View
from ddrecon.terms import needed_terms
from ddrecon.variables.values import fields_of

SHOWN = 24
"""Views whose pictures are on the page; all are in the folder."""
PIXELS = 1_200_000
"""The most pixels that all pictures of views have together."""
GOES_ON = {"kind": "running", "text": "goes on"}
"""The `ended` of a run that still goes on."""
SURE = "How sure they are, experiments say: ddrecon uncertainty RUN -o OUTPUT."
LISTED = 12
"""More numbers of one parameter are not listed."""
FINER = "PSNRs are of pictures as coarse as the cells, and finer ones are harder to match"
"""Why held-out views seem to get worse where the resolution changes."""
LARGEST = 256
"""Pixels along the longer side of a picture, at most."""


def write_run_report(
    path: Path,
    findings: Findings,
    rows: Sequence[Row],
    summary: Mapping[str, Any],
    environment: Mapping[str, Any],
    numbers: Sequence[tuple[str, str, str]],
) -> None:
    """Writes the report of `findings` to `path`, beside scene.yaml; `rows` are the log.

    `numbers` are those of `list_numbers`.
    """
    scene = findings.scene
    versions = ((k, v if isinstance(v, list) else [v]) for k, v in environment.items())
    table = {"heading": "Numbers found", "head": ["", "start", "found"], "rows": numbers}
    table["text"] = SURE
    write_page(
        path,
        title=f"ddrecon: {path.absolute().parent.name}",
        lead=_lead(scene, summary),
        goes_on=summary["ended"]["kind"] == GOES_ON["kind"],
        doubts=[diagnosis["text"] for diagnosis in summary["diagnoses"]],
        volume=describe_findings(findings, summary),
        plots={"heading": "Loss", "drawn": curves(rows), "text": _explain_steps(rows)},
        views=describe_views(findings),
        numbers=table if numbers else None,
        physics=needed_terms(scene),
        settings=path.with_name("scene.yaml").read_text(encoding="utf-8"),
        environment=[(name, " ".join(map(str, values))) for name, values in versions],
    )


def list_numbers(
    parameters: Iterable[Parameter], old_scene: Scene, scene: Scene
) -> list[tuple[str, str, str]]:
    """Names, starts and values of those of `parameters` that are neither fields nor maps.

    The value of a pose is how far the camera of `scene` is moved and turned from `old_scene`.
    """
    rows = []
    for parameter in parameters:
        start, value = (x.detach().flatten() for x in (parameter.start, parameter.value))
        if parameter.key == "camera" and parameter.view is not None:
            old, new = (world.view(parameter.view).camera for world in (old_scene, scene))
            moved = shift_between(old, new, scene.volume)
            apart = float((new.pose - old.pose)[:, :3].norm())  # sqrt(8) sin(angle / 2)
            turned = math.degrees(2 * math.asin(min(1.0, apart / math.sqrt(8))))
            text = f"moved by {moved:.2f} pixels, turned by {turned:.2g} degrees"
            rows.append((parameter.name, "as given", text))
        elif not parameter.is_field and len(value) <= LISTED:
            rows.append((parameter.name, *_tell_change(start, value, parameter.key == "direction")))
    return rows


def _tell_change(start: Tensor, value: Tensor, is_direction: bool) -> tuple[str, str]:
    """The numbers `start` [n], and those found, with their changes: parts of them, or an angle."""
    pairs = list(zip(start.tolist(), value.tolist(), strict=True))
    changes = ["" if is_direction or not x else f" ({y / x - 1:+.1%})" for x, y in pairs]
    end = ", ".join(f"{y:.4g}{text}" for (_, y), text in zip(pairs, changes, strict=True))
    if is_direction:
        apart = float(torch.nn.functional.cosine_similarity(start.double(), value.double(), dim=0))
        end += f" (turned by {math.degrees(math.acos(min(1.0, apart))):.2g} degrees)"
    return ", ".join(f"{x:.4g}" for x in start.tolist()), end


def _lead(scene: Scene, summary: Mapping[str, Any]) -> str:
    cells = " x ".join(str(count) for count in reversed(scene.volume.grid.shape))
    return (
        f"{cells} cells, {summary['iterations']} iterations in {summary['seconds']:.1f} s. "
        f"{psnr_text(summary)}; all compare {summary['compared']}. "
        f"The loss is {summary['loss_function']}. It {summary['ended']['text']}."
    )


def psnr_text(summary: Mapping[str, Any]) -> str:
    """How near the pictures of a run are, of those trained on and those held out."""
    text = f"PSNR {summary['psnr']:.2f} dB"
    if summary.get("test_psnr") is not None:
        text += f", test PSNR {summary['test_psnr']:.2f} dB, SSIM {summary['test_ssim']:.4f}"
    if registered := summary.get("registered"):
        text += f" (registered {registered_text(registered)})"
    return text


def describe_findings(findings: Findings, summary: Mapping[str, Any]) -> dict[str, Any]:
    """Every field that was found, and beside it what the scene file has in its place.

    And what of the volume the `summary` says was left out.
    """
    left_out = list[str]()
    if "support" in summary:
        share = 100 * (1 - summary["support"]["cells"])
        left_out = [f"Left out by the support: {share:.3g} % of the cells."]
    kinds = {"result": fields_of(findings.scene), "truth": findings.truths}
    return describe_fields(findings.scene, kinds, left_out)


def describe_fields(
    scene: Scene,
    kinds: Mapping[str, Mapping[str, Tensor]],
    lines: Sequence[str] = (),
    shown: str = "density",
) -> dict[str, Any]:
    """The section of a page with fields on the grid of `scene`, by kind and name.

    Those of one name have one scale.
    """
    whites = dict[str, float]()
    for name, value in ((n, v) for values in kinds.values() for n, v in values.items()):
        whites[name] = max(whites.get(name, 0.0), find_white_value(value))
    fields = [
        Shown(name, of, value, whites[name])
        for of, values in kinds.items()
        for name, value in values.items()
    ]
    return describe_volume(fields, describe_world(scene.volume.grid, scene), lines, shown)


def curves(rows: Sequence[Row]) -> list[Plot]:
    """Loss and PSNR by iteration."""
    losses = {
        "images": [(float(row.iteration), row.data_loss) for row in rows],
        "penalties": [(float(row.iteration), row.penalty) for row in rows],
    }
    quality = {"trained on": [(float(row.iteration), row.psnr) for row in rows]}
    tests = [(float(row.iteration), row.test_psnr) for row in rows if row.test_psnr is not None]
    if tests:
        quality["held out"] = tests
    steps = [float(row.iteration) for row in _steps(rows)]
    return [
        draw_curve("loss", losses, "iteration", is_logarithmic=True, steps=steps),
        draw_curve("PSNR [dB]", quality, "iteration", steps=steps),
    ]


def _steps(rows: Sequence[Row]) -> list[Row]:
    """The first row of each resolution but the first."""
    return [row for previous, row in pairwise(rows) if row.cells != previous.cells]


def _explain_steps(rows: Sequence[Row]) -> str:
    at = ", ".join(str(row.iteration) for row in _steps(rows))
    return at and f"A line from top to bottom: the cells are finer from there ({at}). {FINER}."


def describe_views(findings: Findings) -> dict[str, Any]:
    """Target and render of the first views, those held out first, and a table of all."""
    views = [view for view in findings.scene.views if view.image is not None]
    shown = sorted(views, key=lambda view: not view.is_test)[:SHOWN]
    white = median(find_white(pixels(target_of(view))) for view in shown)
    most = min(LARGEST, int((PIXELS / (2 * len(shown))) ** 0.5))
    labels = {"Held out": True, "Trained on": False}
    groups = {
        label: [_figure(findings, v, white, most) for v in shown if v.is_test == is_test]
        for label, is_test in labels.items()
    }
    return {
        "white": f"{white:.3g}",
        "groups": [(label, figures) for label, figures in groups.items() if figures],
        "more": len(views) - len(shown),
        "rows": [_describe_view(findings, view) for view in findings.scene.views],
    }


def _figure(findings: Findings, view: View, white: float, most: int) -> tuple[bytes, bytes, str]:
    """Target, render and caption."""
    target, render = (
        webp_of(srgb.encode_bytes(pixels(shrink(image, most)) / white))
        for image in (target_of(view), findings.images[view.name])
    )
    return target, render, f"{view.name}: {_quality_text(findings.quality[view.name])}"


def _describe_view(findings: Findings, view: View) -> tuple[str, ...]:
    height, width = view.camera.size
    split = "test" if view.is_test else "train"
    quality = findings.quality.get(view.name)
    shown = (f"{quality['psnr']:.2f}", f"{quality['ssim']:.4f}") if quality else ("", "")
    return view.name, split, f"{width} x {height}", f"{view.weight:g}", *shown


def _quality_text(quality: Mapping[str, Any]) -> str:
    """PSNR and SSIM, and the exposure and offset that a held-out picture was compared with."""
    text = f"{quality['psnr']:.2f} dB, SSIM {quality['ssim']:.4f}"
    for key in ("exposure", "offset"):
        if f"fitted_{key}" in quality:
            values = ", ".join(f"{value:.3g}" for value in quality[f"fitted_{key}"])
            text += f", {key} {values} fitted to it"
    if registered := quality.get("registered"):
        text += f"; registered {registered_text(registered)}"
    return text


def registered_text(registered: Mapping[str, float]) -> str:
    """How good a view held out is by a camera fitted to the volume, and how far that moved."""
    psnr, ssim, shift = (registered[key] for key in ("psnr", "ssim", "shift"))
    return f"{psnr:.2f} dB, SSIM {ssim:.4f}, smoke moved by {shift:.2f} pixels"
