"""The record and page of a film, of all finished frames, whichever process made them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import torch

from ddrecon.film.folder import Film, fields_in
from ddrecon.film.shared import SHARED
from ddrecon.io.files.atomic import write_json
from ddrecon.io.images.table import read_image, webp_of
from ddrecon.pictures import srgb
from ddrecon.report.page import Plot, draw_curve, write_page
from ddrecon.report.pictures import pixels, shrink
from ddrecon.report.volumes import Shown, describe_volume, describe_world, find_white_value
from ddrecon.run.report import psnr_text
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


def write_film_report(film: Film) -> dict[str, Any]:
    """What `film.json` says of the frames that are done; writes it, a page and a movie."""
    rows, summaries = list[dict[str, Any]](), dict[int, dict[str, Any]]()
    for number in film.done():
        summaries[number] = json.loads((film.of(number) / SUMMARY).read_text())
        row = {key: summaries[number][key] for key in KEYS if summaries[number][key] is not None}
        registered = summaries[number].get("registered", {})
        row |= {f"registered_{key}": value for key, value in registered.items()}
        rows.append({"frame": number, **row})
    record: dict[str, Any] = {"asked": len(film.frames.numbers), "frames": rows}
    if values := film.shared.get("values"):
        record["values"] = values
    write_json(film.path / RECORD, record)
    if rows:
        numbers = [*summaries][:: -(-len(summaries) // SHOWN)]
        write_page(
            film.path / REPORT,
            title=f"ddrecon: {film.path.absolute().name}",
            lead=_lead(record),
            goes_on=len(rows) < record["asked"],
            plots={"heading": "Quality", "drawn": _curves(rows)},
            volume=_volumes(film, numbers),
            frames={"numbers": numbers, "strips": _figures(film, summaries, numbers)},
            numbers=_calibration(film.shared) if values else None,
        )
    return record


def film_lines(record: Mapping[str, Any], folder: Path) -> list[str]:
    """The `record` of a film in `folder`, as lines."""
    return [_lead(record), f"volumes and all else written to {folder}"]


def _lead(record: Mapping[str, Any]) -> str:
    rows = record["frames"]
    means = {key: mean(row[key] for row in rows if key in row) for key in rows[0]}
    kind = "registered_"
    registered = {k.removeprefix(kind): v for k, v in means.items() if k.startswith(kind)}
    text = psnr_text({**means, "registered": registered})
    return f"{len(rows)} of {record['asked']} frames, {means['seconds']:.1f} s each: {text}"


def _curves(rows: Sequence[Mapping[str, Any]]) -> list[Plot]:
    drawn, kinds = [], {"trained on": "", "held out": "test_", "registered": "registered_"}
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
        Shown(name, "result", value, find_white_value(value), number)
        for number in numbers
        for name, value in fields_in(film.of(number), film.optimized).items()
    ]
    whites = {f.name: max(g.white for g in fields if g.name == f.name) for f in fields}
    scaled = [replace(field, white=whites[field.name]) for field in fields]
    return describe_volume(scaled, describe_world(film.grid, film.build(last)), (), fields[0].name)


def _figures(
    film: Film, summaries: Mapping[int, Mapping[str, Any]], numbers: Sequence[int]
) -> list[list[tuple[bytes, str]]]:
    """Pictures of the views held out, or of the first one, in the frames `numbers`."""
    views = next(iter(summaries.values()))["views"]
    shown = [name for name, view in views.items() if view["split"] == "test"] or [*views][:1]
    figures = []
    for name in shown:
        strips = [_strip(film.of(number) / "previews" / f"{name}.png") for number in numbers]
        psnrs = [summaries[number]["views"][name]["psnr"] for number in numbers]
        figures.append(
            [
                (webp_of(srgb.encode_bytes(strip)), f"{name}, frame {number}: {psnr:.2f} dB")
                for number, strip, psnr in zip(numbers, strips, psnrs, strict=True)
            ]
        )
    return figures


def _strip(path: Path) -> np.ndarray:
    image = torch.from_numpy(read_image(path).pixels).permute(2, 0, 1)
    return pixels(shrink(image, WIDEST))


def _calibration(shared: Mapping[str, Any]) -> dict[str, Any]:
    """What all frames share."""
    texts, frames = shared.get("texts", {}), ", ".join(map(str, shared.get("frames", [])))
    return {
        "heading": "Calibration",
        "head": ["number", "value"],
        "rows": [(name, texts.get(name, f"in {SHARED}")) for name in shared["values"]],
        "text": f"Found from frames {frames} together.",
    }
