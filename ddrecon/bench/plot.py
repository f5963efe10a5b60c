"""The picture of a bench: error against time, each kind of variant in its own color."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ddrecon.bench.report import Row, error_of
from ddrecon.extras import load_extra

FLOOR = 1e-8
"""Errors below this are drawn here."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """Writes a PNG of times against errors.

    Left, the time of an image against its error; right, that of an image with its gradient against
    the gradient's numerical error. Raises MissingExtraError where matplotlib is not installed.
    """
    load_extra("matplotlib", "a plot").use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(15, 6.5), layout="constrained")
    has_truth = any(row.image_error is not None for row in rows)
    truth = "path tracing" if has_truth else "the same model solved exactly"
    kinds = list(dict.fromkeys(_kind(row) for row in rows))
    dots = [
        Dot(number, row.name, f"C{kinds.index(_kind(row)) % 10}")
        for number, row in enumerate(rows, 1)
    ]
    pairs = list(zip(dots, rows, strict=True))
    _scatter(left, [(dot, row.image_seconds, error_of(row)) for dot, row in pairs])
    gradients = [(dot, row.both_seconds, row.gradient_numerical) for dot, row in pairs]
    _scatter(right, [(dot, time, error) for dot, time, error in gradients if error is not None])
    front = sorted((row.image_seconds, max(error_of(row), FLOOR)) for row in rows if row.is_best)
    left.step(*zip(*front, strict=True), where="post", color="0.6", linewidth=1, zorder=1)
    left.set(
        xlabel="seconds of an image", ylabel=f"relative RMS error of the image, against {truth}"
    )
    right.set(
        xlabel="seconds of an image and its gradient",
        ylabel="relative RMS error of the gradient, against the same model solved exactly",
    )
    names = [f"{dot.number}  {dot.name}" for dot in dots]
    handles = [plt.Line2D([], [], color=dot.color, marker="o", linestyle="") for dot in dots]
    figure.legend(handles, names, loc="outside right center", fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)


@dataclass(frozen=True)
class Dot:
    """How a row is drawn: a dot with a `number`, which stands beside its name in the legend."""

    number: int
    name: str
    color: str


def _scatter(axis: Any, points: Sequence[tuple[Dot, float, float]]) -> None:
    """Draws dots at (seconds, error).

    Numbers go around the dots in turn, so that those of close dots stay apart.
    """
    for index, (dot, x, y) in enumerate(sorted(points, key=lambda point: point[1])):
        height = max(y, FLOOR)
        axis.scatter([x], [height], color=dot.color, s=36, zorder=3)
        place = ((0, 9), (0, -9), (0, 18), (0, -18))[index % 4]
        axis.annotate(
            str(dot.number),
            (x, height),
            xytext=place,
            textcoords="offset points",
            fontsize=8,
            ha="center",
            va="center",
        )
    axis.set(xscale="log", yscale="log")
    axis.margins(0.08)
    axis.grid(which="major", alpha=0.3)


def _kind(row: Row) -> str:
    return row.name.split(" ")[0]
