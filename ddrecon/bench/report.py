"""The table and the plot of a bench: one row per variant, error beside time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ddrecon.extras import load_extra
from ddrecon.io.files.atomic import write_json
from ddrecon.reference.trace import error_text, least_error
from ddrecon.scene import Scene

FLOOR = 1e-8
"""Errors below this are drawn here."""


@dataclass(frozen=True)
class Row:
    """One variant, or path tracing; errors are relative RMS, None where nothing is to compare with.

    Seconds are medians, `both_seconds` of image and gradient. `image_numerical` and
    `gradient_numerical` are against the same model solved exactly. `image_error` is against path
    tracing, whose `image_noise` is subtracted in quadrature. `iterations` are the first solve's, or
    samples a pixel. `is_best`: no other row is faster and as close to the truth, as far as that can
    be told.
    """

    name: str
    image_seconds: float
    both_seconds: float
    iterations: int
    image_numerical: float | None = None
    gradient_numerical: float | None = None
    image_error: float | None = None
    image_noise: float = 0.0
    is_best: bool = False

    @property
    def error(self) -> float:
        """The error against path tracing, or else against the exact solution; or else infinity.

        What path tracing cannot tell from none counts as the least that it can.
        """
        if self.image_error is not None:
            return max(self.image_error, least_error(self.image_noise))
        return math.inf if self.image_numerical is None else self.image_numerical


def with_best(rows: Sequence[Row]) -> list[Row]:
    """The same rows, those marked that no other beats in both time of an image and error."""
    return [
        replace(
            row,
            is_best=not any(
                other.image_seconds < row.image_seconds and other.error <= row.error
                for other in rows
            ),
        )
        for row in rows
    ]


HEAD = (
    "| variant | image s | + gradient s | times base | iterations | image num. error "
    "| gradient num. error | image error |  |"
)


def bench_lines(rows: Sequence[Row]) -> list[str]:
    """The rows as a Markdown table, with times as multiples of the first's, and Mitsuba's time."""
    base, last = rows[0], rows[-1]
    lines = [HEAD, "|" + " --- |" * (HEAD.count("|") - 1)]
    for row in rows:
        numerical = (row.image_numerical, row.gradient_numerical)
        cells = [
            row.name,
            f"{row.image_seconds:.3f}",
            f"{row.both_seconds:.3f}",
            f"{row.both_seconds / base.both_seconds:.2f}",
            str(row.iterations),
            *("" if error is None else f"{error:.1e}" for error in numerical),
            "" if row.image_error is None else error_text(row.image_error, row.image_noise),
            "best" if row.is_best else "",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    if last.image_error is not None:
        lines.append(
            f"image error is against path tracing, whose noise, {last.image_noise:.2g}, is "
            f"subtracted; {last.name} take {last.image_seconds / base.image_seconds:.3g} times as "
            "long as base"
        )
    return lines


def describe(rows: Sequence[Row], scene: Scene, environment: dict[str, Any]) -> dict[str, Any]:
    """The bench as plain values."""
    height, width = scene.views[0].camera.size
    has_truth = rows[0].image_error is not None
    return {
        "scene": {"cells": list(reversed(scene.volume.grid.shape)), "pixels": [width, height]},
        "truth_noise": {"image": rows[0].image_noise} if has_truth else None,
        "environment": environment,
        "rows": [asdict(row) for row in rows],
    }


def write_bench(folder: Path, rows: Sequence[Row], report: dict[str, Any]) -> None:
    """Writes `report`, which `describe` gives of the `rows`, to bench.json, and draws bench.png.

    Raises MissingExtraError where matplotlib is not installed.
    """
    write_json(folder / "bench.json", report)
    draw(rows, folder / "bench.png")


def draw(rows: Sequence[Row], path: Path) -> None:
    """Writes a PNG of times against errors: of the image, and of image and gradient.

    Dots have the numbers of their rows, and a color for each kind of variant.
    """
    load_extra("matplotlib", "a plot").use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(15, 6.5), layout="constrained")
    kinds = list(dict.fromkeys(row.name.split(" ")[0] for row in rows))
    for number, row in enumerate(rows, 1):
        color, label = f"C{kinds.index(row.name.split(' ')[0]) % 10}", f"{number}  {row.name}"
        dots = (row.image_seconds, row.error), (row.both_seconds, row.gradient_numerical)
        for axis, (seconds, error) in zip(axes, dots, strict=True):
            if error is not None:
                place = seconds, max(error, FLOOR)
                axis.plot(*place, "o", color=color, label=label)
                axis.annotate(str(number), place, (0, 6), textcoords="offset points", ha="center")
    front = sorted((row.image_seconds, max(row.error, FLOOR)) for row in rows if row.is_best)
    axes[0].step(*zip(*front, strict=True), where="post", color="0.6", linewidth=1, zorder=1)
    for axis, what in zip(axes, ("an image", "an image and its gradient"), strict=True):
        axis.set(xscale="log", yscale="log", xlabel=f"seconds of {what}", ylabel="relative error")
        axis.grid(which="major", alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
