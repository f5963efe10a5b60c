"""The folder of samples of a run: deviations of all that was optimized, and the page about them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from ddrecon.io.files.atomic import write_json
from ddrecon.io.images.table import png_of
from ddrecon.report.page import paragraph, picture, section, table, write_page
from ddrecon.report.pictures import slices
from ddrecon.report.volumes import find_white_value
from ddrecon.run.run_folder import write_values
from ddrecon.uncertainty.next_view import rank_views
from ddrecon.uncertainty.samples import Uncertainty
from ddrecon.variables.kinds import kind_of

RECORD = "uncertainty.json"
"""What tells a folder of this kind."""


def write_sample(found: Uncertainty, change: Tensor, path: Path) -> None:
    """Writes the fields of the last sample, `change` from the optimum, to the folder `path`."""
    folder = path / "samples" / f"{found.count - 1:04d}"
    folder.mkdir(parents=True, exist_ok=True)
    parts = found.curvature.split(change)
    for name in _written(found):
        _write(found, folder / name, name, found.curvature.values[name] + parts[name])


def write_found(found: Uncertainty, path: Path, seconds: float) -> dict[str, Any]:
    """What `uncertainty.json` says; writes it, volumes and report to the folder `path`."""
    stated = {"std": found.deviations, "mean": found.means, "told": found.told}
    fields = dict[str, Any]()
    for name in _written(found):
        for kind, values in stated.items():
            _write(found, path / "volumes" / f"{name}_{kind}", name, values[name])
        value, deviation = found.curvature.values[name], stated["std"][name]
        fields[name] = {
            "root_mean_square": float(value.square().mean().sqrt()),
            "deviation": float(deviation.square().mean().sqrt()),
            "told": float(stated["told"][name].mean()),
        }
    known = "the scene" if found.errors.is_known else "residuals"
    record = {
        "samples": found.count,
        "seconds": seconds,
        "products": found.products,
        "residual": found.residual,
        "noise": vars(found.errors) | {"from": known},
        "fields": fields,
        "numbers": found.described_numbers(),
        "correlations": found.correlations().tolist() if found.tabled else [],
        "next_views": rank_views(found),
    }
    write_json(path / RECORD, record)
    write_uncertainty_report(path / "report.html", stated, record)
    return record


def _written(found: Uncertainty) -> list[str]:
    """The names of fields and maps: of all that is no table of numbers."""
    tabled = {parameter.name for parameter in found.tabled}
    return [name for name in found.curvature.values if name not in tabled]


def _write(found: Uncertainty, stem: Path, name: str, value: Tensor) -> None:
    grid = found.curvature.scene.volume.grid
    write_values(stem, stem.name, value, grid, is_map=not kind_of(name).is_cellwise)


def volumes_in(folder: Path) -> list[Path]:
    """The volumes of the `folder` that `drive_uncertainty` wrote, in order; else none."""
    if not (folder / RECORD).is_file():
        return []
    return sorted((folder / "volumes").glob("*.npz"))


def uncertainty_lines(record: Mapping[str, Any], path: Path) -> list[str]:
    """The `record` of a folder `path` as lines."""
    noise = record["noise"]
    return [
        f"{record['samples']} samples in {record['seconds']:.1f} s, {record['products']} products;"
        f" pictures err by {noise['deviation']:.3g} (from {noise['from']})",
        *(
            f"{name}: deviation {field['deviation']:.3g} of {field['root_mean_square']:.3g}"
            f" (root mean squares), {100 * field['told']:.0f} % told by pictures"
            for name, field in record["fields"].items()
        ),
        *(
            f"{name}: {number['value']:.5g} +- {number['deviation']:.2g}"
            for name, number in record["numbers"].items()
        ),
        *(
            f"{'  then ' if place else 'next view: '}{view['name']}, whose picture takes at least "
            f"{100 * view['gain']:.1f} % of the variance (+- {100 * view['error']:.1f})"
            for place, view in enumerate(record["next_views"])
        ),
        f"deviations and report written to {path}",
    ]


def write_uncertainty_report(
    path: Path, stated: Mapping[str, Mapping[str, Tensor]], record: Mapping[str, Any]
) -> None:
    """Writes the page about the fields `stated` by kind and name, and what `record` has of them."""
    sections = [
        section(name.capitalize(), *_field(name, stated, numbers))
        for name, numbers in record["fields"].items()
    ]
    if record["numbers"]:
        rows = [
            (name, f"{number['value']:.5g} ± {number['deviation']:.2g}")
            for name, number in record["numbers"].items()
        ]
        sections.append(section("Numbers", table(["number", "value ± deviation"], rows)))
    if record["next_views"]:
        rows = [
            (view["name"], f"{100 * view['gain']:.1f} ± {100 * view['error']:.1f} %")
            for view in record["next_views"]
        ]
        head = ["picture", "of the variance of all cells, at least"]
        sections.append(section("Next picture", table(head, rows)))
    error = 100 / max(2 * (record["samples"] - 1), 1) ** 0.5
    how = (
        f"A deviation from {record['samples']} samples is itself off by about {error:.0f} %."
        " Told is the part of a cell's variance that pictures took away from what smoothing"
        " alone leaves open, in the mean of the cells around.",
        "All this is about the optimum that was found, for pictures that err by noise alone:"
        " what the model of light lacks is not in it.",
    )
    sections.append(section("How", *map(paragraph, how)))
    title = f"ddrecon: how sure {path.absolute().parent.name} is"
    noise = record["noise"]
    lead = (
        f"{record['samples']} samples in {record['seconds']:.1f} s. Pictures err by"
        f" {noise['deviation']:.3g} of radiance, by {noise['from']}."
    )
    write_page(path, title, lead, sections, is_alive=False)


def _field(
    name: str, stated: Mapping[str, Mapping[str, Tensor]], numbers: Mapping[str, float]
) -> list[str]:
    mean, deviation, told = (stated[kind][name] for kind in ("mean", "std", "told"))
    white, strongest = find_white_value(mean), find_white_value(deviation)
    pictures = [
        (mean, white, f"{name}, mean of the samples: white is {white:.3g}"),
        (deviation, strongest, f"standard deviation: white is {strongest:.3g}"),
        (told, 1.0, "told by pictures: black is nothing, white is all"),
    ]
    shown = "".join(
        picture(png_of(slices(field.float(), white)), caption) for field, white, caption in pictures
    )
    return [
        paragraph(
            f"Deviation {numbers['deviation']:.3g} of {numbers['root_mean_square']:.3g} (root mean"
            f" squares over all cells); {100 * numbers['told']:.0f} % told on average."
            " Slices across z, x and y from left to right."
        ),
        f'<div class="views">{shown}</div>',
    ]
