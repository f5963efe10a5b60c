"""The report of a finished reconstruction, `report.html`: curves, pictures and tables.

Target and render of a view stand side by side as they are displayed.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import torch

from ddrecon.io.images.table import webp_of
from ddrecon.pictures import encode_bytes
from ddrecon.reconstruct.frame import Row
from ddrecon.reconstruct.objective import target_of
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.report.page import Plot, draw_curve, write_page
from ddrecon.report.pictures import find_white, pixels, shrink
from ddrecon.report.volumes import Shown, describe_volume, describe_world
from ddrecon.run.quality import Findings, shift_between
from ddrecon.scene import Scene
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
    scene, left_out = findings.scene, list[str]()
    cells = " x ".join(str(count) for count in reversed(scene.volume.grid.shape))
    lead = (
        f"{cells} cells, {summary['iterations']} iterations in {summary['seconds']:.1f} s. "
        f"{psnr_text(summary)}; all compare {summary['compared']}. "
        f"The loss is {summary['loss_function']}. It {summary['ended']['text']}."
    )
    if "support" in summary:
        share = 100 * (1 - summary["support"]["cells"])
        left_out = [f"Left out by the support: {share:.3g} % of the cells."]
    kinds = {"result": fields_of(scene), "truth": findings.truths}.items()
    fields = [Shown(name, of, value) for of, known in kinds for name, value in known.items()]
    steps = [row for previous, row in pairwise(rows) if row.cells != previous.cells]
    at = ", ".join(str(row.iteration) for row in steps)
    finer = f"A line from top to bottom: the cells are finer from there ({at}). {FINER}."
    versions = ((k, v if isinstance(v, list) else [v]) for k, v in environment.items())
    table = {"heading": "Numbers found", "head": ["", "start", "found"], "rows": numbers}
    table["text"] = SURE
    write_page(
        path,
        title=f"ddrecon: {path.absolute().parent.name}",
        lead=lead,
        goes_on=summary["ended"]["kind"] == GOES_ON["kind"],
        doubts=[diagnosis["text"] for diagnosis in summary["diagnoses"]],
        volume=describe_volume(fields, describe_world(scene.volume.grid, scene), left_out),
        plots={"heading": "Loss", "drawn": curves(rows, steps), "text": finer if steps else ""},
        views=_describe_views(findings),
        numbers=table if numbers else None,
        physics=[*needed_terms(scene)],
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
    for p in parameters:
        start, value = (x.detach().double().flatten() for x in (p.start, p.value))
        if p.key == "camera" and p.view is not None:
            old, new = (world.view(p.view).camera for world in (old_scene, scene))
            moved = shift_between(old, new, scene.volume)
            apart = float((new.pose - old.pose)[:, :3].norm())  # sqrt(8) sin(angle / 2)
            turned = math.degrees(2 * math.asin(min(1.0, apart / math.sqrt(8))))
            text = f"moved by {moved:.2f} pixels, turned by {turned:.3g} degrees"
            rows.append((p.name, "as given", text))
        elif not p.is_field and len(value) <= LISTED:
            pairs = list(zip(start.tolist(), value.tolist(), strict=True))
            if p.key == "direction":
                cosine = torch.nn.functional.cosine_similarity(start, value, dim=0)
                turned = math.degrees(math.acos(min(1.0, float(cosine))))
                text = ", ".join(f"{y:.4g}" for _, y in pairs)
                text += f" (turned by {turned:.3g} degrees)"
            else:
                changes = [f" ({y / x - 1:+.1%})" if x else "" for x, y in pairs]
                ends = zip(pairs, changes, strict=True)
                text = ", ".join(f"{y:.4g}{change}" for (_, y), change in ends)
            rows.append((p.name, ", ".join(f"{x:.4g}" for x, _ in pairs), text))
    return rows


def psnr_text(summary: Mapping[str, Any]) -> str:
    """How near the pictures of a run are, of those trained on and those held out."""
    text = f"PSNR {summary['psnr']:.2f} dB"
    if summary.get("test_psnr") is not None:
        text += f", test PSNR {summary['test_psnr']:.2f} dB, SSIM {summary['test_ssim']:.4f}"
    if registered := summary.get("registered"):
        text += f" (registered {_registered_text(registered)})"
    return text


def curves(rows: Sequence[Row], steps: Sequence[Row] = ()) -> list[Plot]:
    """Loss and PSNR by iteration; `steps` are the first rows of finer cells."""
    columns = {"images": "data_loss", "penalties": "penalty"}, {"trained on": "psnr"}
    if any(row.test_psnr is not None for row in rows):
        columns[1]["held out"] = "test_psnr"
    marks, plots = [float(row.iteration) for row in steps], list[Plot]()
    for title, names in zip(("loss", "PSNR [dB]"), columns, strict=True):
        series = {
            name: [(float(r.iteration), y) for r in rows if (y := getattr(r, key)) is not None]
            for name, key in names.items()
        }
        is_loss = title == "loss"
        plots.append(draw_curve(title, series, "iteration", is_logarithmic=is_loss, steps=marks))
    return plots


def _describe_views(findings: Findings) -> dict[str, Any]:
    """Target and render of the first views, those held out first, and a table of all."""
    views = findings.seen
    shown = sorted(views, key=lambda view: not view.is_test)[:SHOWN]
    white = median(find_white(pixels(target_of(view))) for view in shown)
    most = min(LARGEST, int((PIXELS / (2 * len(shown))) ** 0.5))
    groups: dict[str, list[tuple[bytes, bytes, str]]] = {"Held out": [], "Trained on": []}
    for view in shown:
        target, render = (
            webp_of(encode_bytes(pixels(shrink(image, most)) / white))
            for image in (target_of(view), findings.images[view.name])
        )
        caption = f"{view.name}: {_quality_text(findings.quality[view.name])}"
        groups["Held out" if view.is_test else "Trained on"].append((target, render, caption))
    rows = []
    for view in findings.scene.views:
        height, width = view.camera.size
        quality = findings.quality.get(view.name)
        scores = (f"{quality['psnr']:.2f}", f"{quality['ssim']:.4f}") if quality else ("", "")
        split = "test" if view.is_test else "train"
        rows.append((view.name, split, f"{width} x {height}", f"{view.weight:g}", *scores))
    return {
        "white": f"{white:.3g}",
        "groups": [(label, figures) for label, figures in groups.items() if figures],
        "more": len(views) - len(shown),
        "rows": rows,
    }


def _quality_text(quality: Mapping[str, Any]) -> str:
    """PSNR and SSIM, and the exposure and offset that a held-out picture was compared with."""
    text = f"{quality['psnr']:.2f} dB, SSIM {quality['ssim']:.4f}"
    for key in ("exposure", "offset"):
        if f"fitted_{key}" in quality:
            values = ", ".join(f"{value:.3g}" for value in quality[f"fitted_{key}"])
            text += f", {key} {values} fitted to it"
    registered = quality.get("registered")
    return text + (f"; registered {_registered_text(registered)}" if registered else "")


def _registered_text(registered: Mapping[str, float]) -> str:
    """How good a view held out is by a camera fitted to the volume, and how far that moved."""
    psnr, ssim, shift = (registered[key] for key in ("psnr", "ssim", "shift"))
    return f"{psnr:.2f} dB, SSIM {ssim:.4f}, smoke moved by {shift:.2f} pixels"
