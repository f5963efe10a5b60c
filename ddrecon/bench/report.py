"""The table and the record of a bench: one row per variant, errors beside the time they take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ddrecon.bench.measure import Shot, Timing, correlation, relative_error
from ddrecon.bench.variants import Variant


@dataclass(frozen=True)
class Row:
    """One variant. Seconds are medians, `both_seconds` of image and gradient; errors are relative RMS; None where there is no path tracing.

    `image_numerical` and `gradient_numerical` are against the same model solved exactly; `image_error` is against path tracing, its noise
    subtracted in quadrature, `gradient_correlation` with path replay's gradient. `is_best`: no other row is faster and closer to the truth.
    """

    name: str
    image_seconds: float
    both_seconds: float
    iterations: int
    image_numerical: float
    gradient_numerical: float
    image_error: float | None = None
    gradient_correlation: float | None = None
    is_best: bool = False


@dataclass(frozen=True)
class Truth:
    """Path tracing: `image` [3, h, w] with its relative `noise`, and `gradient` over blocks, None where it was not made."""

    image: Any
    noise: float
    gradient: Any = None

    def error(self, image: Any) -> float:
        """The relative RMS error of `image`, less the truth's own noise in quadrature."""
        return max(0.0, relative_error(image, self.image) ** 2 - self.noise**2) ** 0.5


def rows_of(variants: Sequence[Variant], timings: dict[str, Timing], exact: dict[str, Shot], truth: Truth | None) -> list[Row]:
    """A row for every variant that was measured, in their order."""
    rows = [_row(variant.name, timings[variant.name], exact[variant.name], truth) for variant in variants if variant.name in timings]
    return with_best(rows)


def with_best(rows: Sequence[Row]) -> list[Row]:
    """The same rows, those marked that no other beats in both time of an image and error."""

    def is_beaten(row: Row) -> bool:
        return any(other.image_seconds < row.image_seconds and error_of(other) < error_of(row) for other in rows)

    return [Row(**{**asdict(row), "is_best": not is_beaten(row)}) for row in rows]


def error_of(row: Row) -> float:
    """Against path tracing, or where there is none against the exact solution."""
    return row.image_numerical if row.image_error is None else row.image_error


def _row(name: str, timing: Timing, exact: Shot, truth: Truth | None) -> Row:
    shot, (image_seconds, both_seconds) = timing.shots[0], timing.seconds
    numerical = relative_error(shot.image, exact.image), relative_error(shot.gradient, exact.gradient)
    error = truth.error(shot.image) if truth is not None else None
    agreement = correlation(shot.gradient, truth.gradient) if truth is not None and truth.gradient is not None else None
    return Row(name, image_seconds, both_seconds, shot.iterations, *numerical, error, agreement)


def table(rows: Sequence[Row]) -> list[str]:
    """The rows as a Markdown table; times also as multiples of the first row's."""
    head = [
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
    lines = [_line(head), _line(["---"] * len(head))]
    for row in rows:
        shown = [
            f"{row.image_seconds:.3f}",
            f"{row.both_seconds:.3f}",
            f"{row.both_seconds / rows[0].both_seconds:.2f}",
            str(row.iterations),
        ]
        shown += [f"{row.image_numerical:.1e}", f"{row.gradient_numerical:.1e}"]
        shown += ["" if value is None else f"{value:.3f}" for value in (row.image_error, row.gradient_correlation)]
        lines.append(_line([row.name, *shown, "best" if row.is_best else ""]))
    return lines


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
