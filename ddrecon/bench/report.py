"""The table and the record of a bench: one row per variant, errors beside the time they take."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ddrecon.bench.measure import Shot, Timing, correlation, relative_error
from ddrecon.bench.path_tracing import Truth
from ddrecon.reference.trace import error_text, least_error
from ddrecon.report import page
from ddrecon.report.page import paragraph, picture, section, write_page


@dataclass(frozen=True)
class Row:
    """One variant, or path tracing; errors are relative RMS, None where nothing is to compare with.

    Seconds are medians, `both_seconds` of image and gradient. `image_numerical` and
    `gradient_numerical` are against the same model solved exactly. `image_error` is against path
    tracing, whose `image_noise` is subtracted in quadrature; `gradient_correlation` is with path
    replay's gradient times density. `iterations` are the first solve's, or samples a pixel.
    `is_best`: no other row is faster and as close to the truth, as far as that can be told.
    """

    name: str
    image_seconds: float
    both_seconds: float
    iterations: int
    image_numerical: float | None = None
    gradient_numerical: float | None = None
    image_error: float | None = None
    image_noise: float = 0.0
    gradient_correlation: float | None = None
    is_best: bool = False


def rows_of(
    timings: Mapping[str, Timing], exact: Mapping[str, Shot], truth: Truth | None
) -> list[Row]:
    """A row for every contestant that was measured; `exact` holds the exact solutions, if any."""
    return with_best(
        [_row(name, timing, exact.get(name), truth) for name, timing in timings.items()]
    )


def with_best(rows: Sequence[Row]) -> list[Row]:
    """The same rows, those marked that no other beats in both time of an image and error."""

    def is_beaten(row: Row) -> bool:
        return any(
            other.image_seconds < row.image_seconds and error_of(other) <= error_of(row)
            for other in rows
        )

    return [replace(row, is_best=not is_beaten(row)) for row in rows]


def error_of(row: Row) -> float:
    """The error against path tracing, or else against the exact solution; or else infinity.

    What path tracing cannot tell from none counts as the least that it can.
    """
    if row.image_error is not None:
        return max(row.image_error, least_error(row.image_noise))
    return math.inf if row.image_numerical is None else row.image_numerical


def _row(name: str, timing: Timing, exact: Shot | None, truth: Truth | None) -> Row:
    shot = timing.shots[0]
    row = Row(name, *timing.seconds, shot.iterations)
    if exact is not None:
        row = replace(
            row,
            image_numerical=relative_error(shot.image, exact.image),
            gradient_numerical=relative_error(shot.gradient, exact.gradient),
        )
    if truth is not None:
        error = truth.image.error(shot.image.numpy())
        row = replace(row, image_error=error, image_noise=truth.image.noise)
        if truth.by_amount is not None:
            expected = torch.from_numpy(truth.by_amount.image)
            row = replace(row, gradient_correlation=correlation(shot.by_amount, expected))
    return row


HEAD = [
    "variant",
    "image s",
    "+ gradient s",
    "times base",
    "iterations",
    "image num. error",
    "gradient num. error",
    "image error",
    "gradient corr.",
    "",
]
"""The columns of the table."""


def cells(rows: Sequence[Row]) -> list[list[str]]:
    """The rows as text under `HEAD`; times also as multiples of the first row's."""
    return [_cells(row, rows[0]) for row in rows]


def _cells(row: Row, base: Row) -> list[str]:
    times = [
        f"{row.image_seconds:.3f}",
        f"{row.both_seconds:.3f}",
        f"{row.both_seconds / base.both_seconds:.2f}",
        str(row.iterations),
    ]
    numerical = [
        "" if value is None else f"{value:.1e}"
        for value in (row.image_numerical, row.gradient_numerical)
    ]
    error = "" if row.image_error is None else error_text(row.image_error, row.image_noise)
    correlated = "" if row.gradient_correlation is None else f"{row.gradient_correlation:.3f}"
    return [row.name, *times, *numerical, error, correlated, "best" if row.is_best else ""]


def table(rows: Sequence[Row]) -> list[str]:
    """The rows as a Markdown table."""
    return [f"| {' | '.join(line)} |" for line in (HEAD, ["---"] * len(HEAD), *cells(rows))]


def write_bench_report(
    path: Path,
    rows: Sequence[Row],
    remarks: Sequence[str],
    plot: bytes | None,
    environment: Mapping[str, Any],
) -> None:
    """Writes `rows`, `remarks` on them, the `plot` (a PNG) if any, and versions as a page."""
    caption = "numbers are those of the legend; the line joins the best"
    drawn = [section("Error against time", picture(plot, caption, 1080))] if plot else []
    versions = [
        (key, " ".join(map(str, value)) if isinstance(value, list) else value)
        for key, value in environment.items()
    ]
    sections = [
        *drawn,
        section("Variants", page.table(HEAD, cells(rows)), *map(paragraph, remarks)),
        section("Versions", page.table(["", ""], versions)),
    ]
    lead = "Speed against error: medians of whole renders, in one run."
    write_page(path, "ddrecon bench", lead, sections)
