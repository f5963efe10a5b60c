"""The page about how sure a run is: mean, deviation and what pictures told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from ddrecon.io.images.table import png_of
from ddrecon.report.page import paragraph, picture, section, table, write_page
from ddrecon.report.pictures import slices
from ddrecon.report.volumes import find_white_value
from ddrecon.uncertainty.samples import Uncertainty

STRONG = 0.5
"""Correlations above this are told of."""


def write_uncertainty_report(path: Path, found: Uncertainty, record: Mapping[str, Any]) -> None:
    """Writes the page about what was `found`, which `record` has in numbers."""
    means, deviations, told = found.means, found.deviations, found.told
    sections = [
        section(
            name.capitalize(),
            *_field(name, means[name], deviations[name], told[name], record["fields"][name]),
        )
        for name in record["fields"]
    ]
    if record["numbers"]:
        sections.append(section("Numbers", *_numbers(record)))
    if record["next_views"]:
        sections.append(section("Next picture", *_next_views(record)))
    sections.append(section("How", *_how(record)))
    title = f"ddrecon: how sure {path.absolute().parent.name} is"
    write_page(path, title, _lead(record), sections, is_alive=False)


def _lead(record: Mapping[str, Any]) -> str:
    noise = record["noise"]
    source = "what the reconstruction leaves" if noise["told"] is not None else "the scene"
    return (
        f"{record['samples']} samples in {record['seconds']:.1f} s. "
        f"Pictures err by {noise['deviation']:.3g} of radiance, by {source}."
    )


def _field(
    name: str, mean: Tensor, deviation: Tensor, told: Tensor, numbers: Mapping[str, float]
) -> list[str]:
    """Slices of a field."""
    white = find_white_value(mean)
    strongest = find_white_value(deviation)
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


def _numbers(record: Mapping[str, Any]) -> list[str]:
    """The table of numbers with their deviations, and of those that hang together."""
    names = list(record["numbers"])
    rows = [
        (name, f"{number['value']:.5g} ± {number['deviation']:.2g}")
        for name, number in record["numbers"].items()
    ]
    parts = [table(["number", "value ± deviation"], rows)]
    pairs = [
        (names[i], names[j], f"{row[j]:+.2f}")
        for i, row in enumerate(record["correlations"])
        for j in range(i)
        if abs(row[j]) > STRONG
    ]
    if pairs:
        parts += [
            paragraph(f"Numbers that hang together (correlation above {STRONG} by these samples):"),
            table(["", "", "correlation"], pairs),
        ]
    return parts


def _next_views(record: Mapping[str, Any]) -> list[str]:
    """The table of pictures that would tell most."""
    views = record["next_views"]
    has_lights = any(view["light_directions"] for view in views)
    rows = [
        (
            view["name"],
            f"{100 * view['gain']:.1f} ± {100 * view['error']:.1f} %",
            _vector([row[3] for row in view["matrix"][:3]]),
            "; ".join(_vector(way) for way in view["light_directions"]),
        )[: 4 if has_lights else 3]
        for view in views
    ]
    head = ["picture", "of the variance, at least", "camera at x, y, z", "light travels along"]
    return [
        paragraph(
            "How much of the variance of all cells each of these pictures would take away at least,"
            " if it errs as the others do. Matrices of cameras are in uncertainty.json."
        ),
        table(head[: 4 if has_lights else 3], rows),
    ]


def _vector(values: Sequence[float]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def _how(record: Mapping[str, Any]) -> list[str]:
    """What stands behind the numbers."""
    count = record["samples"]
    error = 100 / max(2 * (count - 1), 1) ** 0.5
    return [
        paragraph(
            f"A deviation from {count} samples is itself off by about {error:.0f} %."
            " Told is the part of a cell's variance that pictures took away from what smoothing"
            " alone leaves open, in the mean of the cells around."
        ),
        paragraph(
            "All this is about the optimum that was found, for pictures that err by noise alone:"
            " what the model of light lacks is not in it."
        ),
        table(["pictures", ""], _noise(record["noise"])),
    ]


def _noise(noise: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What is known of how pictures err, and of what they tell."""
    rows = [
        ("deviation of a pixel, in radiance", f"{noise['deviation']:.3g}"),
        ("known from", str(noise["from"])),
        ("numbers in all pictures", str(noise["count"])),
    ]
    if noise["told"] is not None:
        rows.append(("of these spent on telling the volume", f"{noise['told']:.0f}"))
    return rows
