"""The folder of how sure a run is: deviations of all that was optimized, and their page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.folders import UNCERTAINTY, kind_of_folder
from ddrecon.io.images.table import png_of
from ddrecon.report.curve import draw_bars
from ddrecon.report.page import paragraph, picture, section, table, write_page
from ddrecon.report.pictures import see_through, slices
from ddrecon.report.volumes import find_white_value
from ddrecon.run.run_folder import write_values
from ddrecon.uncertainty.deviations import RATIO, Deviations, Field
from ddrecon.variables.kinds import kind_of

RECORD = "uncertainty.json"
ASSUMED = (
    "Deviations come from experiments: the reconstruction was photographed, with more transport"
    " rounds than the run had and the errors of its pictures, and reconstructed by the same"
    f" settings. They are scaled by {RATIO}, the ratio of true to simulated errors on four volumes"
    " of known truth. Cameras, lights and optics that were not optimized are taken for true, and of"
    " what no camera sees experiments say nothing."
)


def write_deviations(deviations: Deviations, path: Path, seconds: float) -> dict[str, Any]:
    """What `uncertainty.json` says; writes it, volumes and report to `path`."""
    experiments, fields = deviations.experiments, deviations.fields
    for name, field in fields.items():
        for kind, values in {"std": field.deviation, "mean": field.value}.items():
            stem, is_map = path / "volumes" / f"{name}_{kind}", not kind_of(name).is_cellwise
            write_values(stem, stem.name, values, field.parameter.grid, is_map=is_map)
    record = {
        "experiments": experiments.count,
        "seconds": seconds,
        "iterations": experiments.iteration,
        "noise": {
            "deviation": experiments.deviation,
            "from": "the scene" if experiments.is_noise_known else "residuals",
        },
        "assumed": ASSUMED,
        "fields": {name: field.describe() for name, field in fields.items()},
        "numbers": deviations.numbers(),
    }
    write_json(path / RECORD, record)
    write_uncertainty_report(path / "report.html", fields, record)
    return record


def volumes_in(folder: Path) -> list[Path]:
    """The volumes of the `folder` that `drive_uncertainty` wrote, in order; else none."""
    is_sure = kind_of_folder(folder) == UNCERTAINTY
    return sorted((folder / "volumes").glob("*.npz")) if is_sure else []


def uncertainty_lines(record: Mapping[str, Any], path: Path) -> list[str]:
    """The `record` of a folder `path` as lines."""
    return [
        _lead(record),
        *(f"{name}: {_about(field)}" for name, field in record["fields"].items()),
        *(f"{name}: {_number(number)}" for name, number in record["numbers"].items()),
        record["assumed"],
        f"deviations and report written to {path}",
    ]


def _lead(record: Mapping[str, Any]) -> str:
    noise = record["noise"]
    return (
        f"experiments: {record['experiments']}, in {record['seconds']:.1f} s; pictures err by"
        f" {noise['deviation']:.3g} of radiance (from {noise['from']})"
    )


def _about(field: Mapping[str, Any]) -> str:
    size, of = field["deviation"], field["root_mean_square"]
    text = f"deviation {size:.3g} of {of:.3g} (root mean squares over the smoke)"
    if field["within_1"] is not None:
        shares = " and ".join(f"{100 * field[f'within_{k}']:.0f} %" for k in (1, 2))
        text += f"; of errors in experiments {shares} lay within one and two deviations"
    return text


def _number(number: Mapping[str, float]) -> str:
    return f"{number['value']:.5g} +- {number['deviation']:.2g}"


def write_uncertainty_report(
    path: Path, fields: Mapping[str, Field], record: Mapping[str, Any]
) -> None:
    """Writes the page about the `fields` by name, and what `record` has of them."""
    sections = [
        section(name.capitalize(), *_field(name, field, record["fields"][name]))
        for name, field in fields.items()
    ]
    if record["numbers"]:
        rows = [(name, _number(number)) for name, number in record["numbers"].items()]
        sections.append(section("Numbers", *_bars(record["numbers"]), table(["", ""], rows)))
    sections.append(section("How", paragraph(record["assumed"])))
    title = f"ddrecon: how sure {path.absolute().parent.name} is"
    write_page(path, title, f"{_lead(record).capitalize()}.", sections)


def _field(name: str, field: Field, described: Mapping[str, Any]) -> list[str]:
    value, deviation = field.value, field.deviation
    strongest = find_white_value(deviation)
    pictures = [(slices(deviation, strongest), f"deviation: white is {strongest:.3g}")]
    if field.parameter.is_field:
        size, off = (
            volume.reshape(-1, *volume.shape[-3:]).abs().mean(0) for volume in (value, deviation)
        )
        seen = see_through(size, off / size.clamp(min=1e-3 * float(size.max())))
        caption = "opaque by what was found; blue is sure, white off by half, red by all of it"
        pictures.insert(0, (seen, caption))
    shown = "".join(picture(png_of(pixels), caption) for pixels, caption in pictures)
    return [
        paragraph(f"{_about(described).capitalize()}. Seen along z, x and y from left to right."),
        f'<div class="views">{shown}</div>',
    ]


def _bars(numbers: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Pictures of the `numbers` with their deviations, a picture for all of one kind."""
    kinds = dict[str, list[tuple[str, float, float]]]()
    for name, number in numbers.items():
        kind = name.split(".", 2)[-1] if name.startswith(("views.", "lights.")) else name
        kinds.setdefault(kind, []).append((name, number["value"], number["deviation"]))
    return [draw_bars(rows) for rows in kinds.values()]
