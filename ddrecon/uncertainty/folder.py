"""The folder of how sure a run is: deviations of all that was optimized, and their page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from ddrecon.io.files.atomic import write_json
from ddrecon.io.files.folders import UNCERTAINTY, kind_of_folder
from ddrecon.io.images.table import png_of
from ddrecon.report.curve import draw_bars
from ddrecon.report.page import items, paragraph, picture, section, table, write_page
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
    " of known truth. Cameras, lights and optics that were not optimized are taken for true."
)
CAVEAT = (
    "Not calibrated (--calibrate 0): deviations know noise alone, and are several times too small."
)


def write_deviations(
    deviations: Deviations,
    views: Sequence[Mapping[str, Any]],
    samples: int,
    path: Path,
    seconds: float,
) -> dict[str, Any]:
    """What `uncertainty.json` says; writes it, volumes, so many `samples` and report to `path`.

    `views` are those that may come next.
    """
    experiments, fields = deviations.experiments, deviations.fields
    for name, field in fields.items():
        stated = {"std": field.deviation, "mean": field.value}
        if experiments.count:
            stated["explained"] = field.explained
        for kind, values in stated.items():
            _write(field, path / "volumes" / f"{name}_{kind}", name, values)
    for number in range(samples):
        folder = path / "samples" / f"{number:04d}"
        folder.mkdir(parents=True, exist_ok=True)
        changes = experiments.curvature.split(deviations.draw(number))
        for name, field in fields.items():
            p, sample = field.parameter, field.value + changes[name].cpu()
            _write(field, folder / name, name, sample.clamp(p.low, p.high))
    record = {
        "experiments": experiments.count,
        "seconds": seconds,
        "iterations": experiments.iteration,
        "noise": {
            "deviation": experiments.deviation,
            "from": "the scene" if experiments.is_noise_known else "residuals",
        },
        "assumed": ASSUMED if experiments.count else CAVEAT,
        "fields": {name: field.describe() for name, field in fields.items()},
        "numbers": deviations.numbers(),
        "next_views": list(views),
    }
    write_json(path / RECORD, record)
    write_uncertainty_report(path / "report.html", fields, record)
    return record


def _write(field: Field, stem: Path, name: str, value: Tensor) -> None:
    is_map = not kind_of(name).is_cellwise
    write_values(stem, stem.name, value, field.parameter.grid, is_map=is_map)


def volumes_in(folder: Path) -> list[Path]:
    """The volumes of the `folder` that `drive_uncertainty` wrote, in order; else none."""
    is_sure = kind_of_folder(folder) == UNCERTAINTY
    return sorted((folder / "volumes").glob("*.npz")) if is_sure else []


def uncertainty_lines(record: Mapping[str, Any], path: Path) -> list[str]:
    """The `record` of a folder `path` as lines."""
    noise = record["noise"]
    return [
        f"experiments: {record['experiments']}, in {record['seconds']:.1f} s;"
        f" pictures err by {noise['deviation']:.3g} (from {noise['from']})",
        *(
            line
            for name, field in record["fields"].items()
            for line in (
                f"{name}: {_about(field)}",
                *(f"  {text}" for text in _classes(field)),
            )
        ),
        *(f"{name}: {_number(number)}" for name, number in record["numbers"].items()),
        *(
            f"{'  then ' if place else 'next view: '}{view['name']} {_describe_angle(view, place)}"
            for place, view in enumerate(record["next_views"])
        ),
        record["assumed"],
        f"deviations and report written to {path}",
    ]


def _about(field: Mapping[str, Any]) -> str:
    deviation, of, explained = (field[n] for n in ("deviation", "root_mean_square", "explained"))
    size = f"deviation {deviation:.3g} of {of:.3g} (root mean squares over the smoke)"
    if explained is None:
        return f"{size} by noise alone, which is several times too small"
    return f"{size}; pictures explain {100 * explained:.0f} % of the variance"


def _classes(field: Mapping[str, Any]) -> list[str]:
    """A line for each class of the cells of a `field`: how many, and how often experiments held."""
    lines = []
    for name, of in field["classes"].items():
        remark = ", where pictures tell nothing" if name == "unseen" else ""
        line = f"{name}{remark}: {100 * of['share']:.0f} % of the smoke"
        if "within_1" in of:
            low, high = min(of["factors"]), max(of["factors"])
            shares = [100 * of[f"within_{k}"] for k in (1, 2)]
            line += f"; a deviation is {of['factor']:.2f} ({low:.2f} to {high:.2f}) errors around"
            line += "; in experiments {:.0f} % of errors lay within one, {:.0f} % within two"
            line = line.format(*shares)
        lines.append(line)
    return lines


def _number(number: Mapping[str, float | None]) -> str:
    deviation = number["deviation"]
    spread = "unknown without experiments" if deviation is None else f"{deviation:.2g}"
    return f"{number['value']:.5g} +- {spread}"


def _describe_angle(view: Mapping[str, Any], place: int) -> str:
    """How far off the picture at this `place` in the ranking is."""
    tied = ", not to be distinguished from the first" if place and view["is_tied"] else ""
    return f"{view['angle']:.0f} degrees from the nearest picture{tied}"


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
    if record["next_views"]:
        rows = [
            (view["name"], _describe_angle(view, at))
            for at, view in enumerate(record["next_views"])
        ]
        sections.append(section("Next picture", table(["picture", ""], rows)))
    sections.append(section("How", paragraph(record["assumed"])))
    title = f"ddrecon: how sure {path.absolute().parent.name} is"
    noise = record["noise"]
    lead = (
        f"Experiments: {record['experiments']}, in {record['seconds']:.1f} s. Pictures err by"
        f" {noise['deviation']:.3g} of radiance, by {noise['from']}."
    )
    write_page(path, title, lead, sections, is_alive=False)


def _field(name: str, field: Field, described: Mapping[str, Any]) -> list[str]:
    value, deviation = field.value, field.deviation
    strongest = find_white_value(deviation)
    pictures = [(slices(deviation, strongest), f"deviation: white is {strongest:.3g}")]
    if field.errors:
        caption = "explained by pictures: black is nothing, white is all"
        pictures.append((slices(field.explained, 1.0), caption))
    if field.parameter.is_field and field.errors:
        size, off = (
            volume.reshape(-1, *volume.shape[-3:]).abs().mean(0) for volume in (value, deviation)
        )
        seen = see_through(size, off / size.clamp(min=1e-3 * float(size.max())))
        caption = "opaque by what was found; blue is sure, white off by half, red by all of it"
        pictures.insert(0, (seen, caption))
    shown = "".join(picture(png_of(pixels), caption) for pixels, caption in pictures)
    return [
        paragraph(f"{_about(described).capitalize()}. Seen along z, x and y from left to right."),
        items(_classes(described)),
        f'<div class="views">{shown}</div>',
    ]


def _bars(numbers: Mapping[str, Mapping[str, float | None]]) -> list[str]:
    """Pictures of the `numbers` with their deviations, a picture for all of one kind."""
    kinds = dict[str, list[tuple[str, float, float]]]()
    for name, number in numbers.items():
        value, deviation = number["value"], number["deviation"]
        if value is not None and deviation is not None:
            kind = name.split(".", 2)[-1] if name.startswith(("views.", "lights.")) else name
            kinds.setdefault(kind, []).append((name, value, deviation))
    return [draw_bars(rows) for rows in kinds.values()]
