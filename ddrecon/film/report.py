"""The record and page of a film, of all finished frames, whichever process made them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from statistics import mean
from time import monotonic
from typing import Any

import torch

from ddrecon.film.drive import SHARED, Film, drive_frames, export_film, fields_in
from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.folders import FILM
from ddrecon.io.images.table import read_image, webp_of
from ddrecon.pictures import srgb
from ddrecon.report.page import Plot, draw_curve, write_page
from ddrecon.report.pictures import pixels, shrink
from ddrecon.run.job import Outcome
from ddrecon.run.report import describe_fields, psnr_text
from ddrecon.run.result import RESULT
from ddrecon.run.run_folder import REPORT, SUMMARY
from ddrecon.scene_file.build_views import remove_pictures
from ddrecon.scene_file.load import read_scene

RECORD = "film.json"
KEYS = ("iterations", "seconds", "psnr", "ssim", "test_psnr", "test_ssim")
"""Entries of a run's summary that a film's record keeps of each frame."""
SHOWN = 48
"""Frames whose pictures and volumes are on the page; all are in their folders."""
WIDEST = 768
"""Pixels across target, render and difference, at most."""
REPORT_SHARE = 0.05
"""While frames are made, their page takes no more than this part of the time."""


def drive_film(
    film: Film, numbers: Sequence[int], exported: str | None, up: str | None = None
) -> Outcome:
    """Tells of `film` after its frames `numbers`, those that are not yet done.

    All that are done then are `exported` as volumes of this kind, in which the axis `up` points up.
    Raises as `drive_frames` does.
    """
    finished, due = film.done(), 0.0
    try:
        for number in drive_frames(film, numbers):
            if number not in finished and monotonic() >= due:
                start = monotonic()
                _report(film)
                due = monotonic() + (monotonic() - start) / REPORT_SHARE
    finally:
        outcome = _report(film)
    if exported is not None:
        with film.claim(film.path, FILM):
            export_film(film, exported, up)
    return outcome


def _report(film: Film) -> Outcome:
    # The last of several parts to come knows of all that are done.
    with film.claim(film.path, FILM):
        return write_film_report(film)


def write_film_report(film: Film) -> Outcome:
    """Tells of the frames of `film` that are done; writes the record, `film.json`, and a page."""
    rows, summaries = list[dict[str, Any]](), dict[int, dict[str, Any]]()
    for number in film.done():
        summary = summaries[number] = json.loads((film.of(number) / SUMMARY).read_text())
        row = {key: summary[key] for key in KEYS if summary[key] is not None}
        rows.append({"frame": number, **row})
    record: dict[str, Any] = {"asked": len(film.frames.numbers), "frames": rows}
    if values := film.shared.get("values"):
        record["values"] = values
    write_json(film.path / RECORD, record)
    if not rows:
        return record, ["no frame is done"]
    means = {key: mean(row[key] for row in rows if key in row) for key in rows[0]}
    count_text = f"{len(rows)} of {record['asked']} frames, {means['seconds']:.1f} s each"
    lead = f"{count_text}: {psnr_text(means)}"
    numbers = [*summaries][:: -(-len(summaries) // SHOWN)]
    write_page(
        film.path / REPORT,
        title=f"ddrecon: {film.path.absolute().name}",
        lead=lead,
        goes_on=len(rows) < record["asked"],
        plots={"heading": "Quality", "drawn": _curves(rows)},
        volume=_volumes(film, numbers),
        frames={"numbers": numbers, "strips": _figures(film, summaries, numbers)},
        numbers=_calibration(film.shared) if values else None,
    )
    return record, [lead]


def _curves(rows: Sequence[Mapping[str, Any]]) -> list[Plot]:
    drawn, kinds = [], {"trained on": "", "held out": "test_"}
    for title, key in (("PSNR [dB]", "psnr"), ("SSIM", "ssim")):
        series = {
            name: [(float(row["frame"]), row[kind + key]) for row in rows if kind + key in row]
            for name, kind in kinds.items()
        }
        drawn.append(draw_curve(title, {n: s for n, s in series.items() if s}, "frame"))
    return drawn


def _volumes(film: Film, numbers: Sequence[int]) -> dict[str, Any]:
    """The fields of the frames `numbers`, and what stands around them by the last one."""
    last = remove_pictures(read_scene(film.of(numbers[-1]) / RESULT), None)
    fields = [
        (name, "result", value, number)
        for number in numbers
        for name, value in fields_in(film.of(number), film.optimized).items()
    ]
    return describe_fields(film.build(last), fields, (), fields[0][0])


def _figures(
    film: Film, summaries: Mapping[int, Mapping[str, Any]], numbers: Sequence[int]
) -> list[list[tuple[bytes, str]]]:
    """Pictures of the views held out, or of the first one, in the frames `numbers`."""
    views = next(iter(summaries.values()))["views"]
    names = [name for name, view in views.items() if view["split"] == "test"] or [*views][:1]
    strips: list[list[tuple[bytes, str]]] = [[] for _ in names]
    for name, strip in zip(names, strips, strict=True):
        for number in numbers:
            stored = read_image(film.of(number) / "previews" / f"{name}.png").pixels
            image = shrink(torch.from_numpy(stored).permute(2, 0, 1), WIDEST)
            psnr = summaries[number]["views"][name]["psnr"]
            caption = f"{name}, frame {number}: {psnr:.2f} dB"
            strip.append((webp_of(srgb.encode_bytes(pixels(image))), caption))
    return strips


def _calibration(shared: Mapping[str, Any]) -> dict[str, Any]:
    """What all frames share."""
    texts, frames = shared.get("texts", {}), ", ".join(map(str, shared.get("frames", [])))
    return {
        "heading": "Calibration",
        "head": ["number", "value"],
        "rows": [(name, texts.get(name, f"in {SHARED}")) for name in shared["values"]],
        "text": f"Found from frames {frames} together.",
    }
