"""The picture of a bench: error against time, each kind of variant in its own color."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ddrecon.bench.report import Row, error_of

FLOOR = 1e-8
"""Errors below this are drawn here."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """Writes a PNG: the time of an image against its error, and of an image with its gradient against the gradient's numerical error.

    Raises ModuleNotFoundError where matplotlib is not installed.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 6), layout="constrained")
    truth = "path tracing" if any(row.image_error is not None for row in rows) else "the same model solved exactly"
    _scatter(left, [(row, row.image_seconds, error_of(row)) for row in rows])
    _scatter(right, [(row, row.both_seconds, row.gradient_numerical) for row in rows if row.gradient_numerical is not None])
    front = sorted((row.image_seconds, max(error_of(row), FLOOR)) for row in rows if row.is_best)
    left.step(*zip(*front, strict=True), where="post", color="0.6", linewidth=1, zorder=1)
    left.set(xlabel="seconds of an image", ylabel=f"relative RMS error of the image, against {truth}")
    right.set(
        xlabel="seconds of an image and its gradient", ylabel="relative RMS error of the gradient, against the same model solved exactly"
    )
    left.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _scatter(axis: Any, points: Sequence[tuple[Row, float, float]]) -> None:
    """Draws rows at (seconds, error), a color for each kind of variant; notes are staggered where points are close."""
    kinds = list(dict.fromkeys(_kind(row) for row, _, _ in points))
    for index, kind in enumerate(kinds):
        seconds, errors = zip(*((x, max(y, FLOOR)) for row, x, y in points if _kind(row) == kind), strict=True)
        axis.scatter(seconds, errors, color=f"C{index % 10}", label=kind, s=36, zorder=3)
    for index, (row, x, y) in enumerate(sorted(points, key=lambda point: point[1])):
        place = {"xytext": (4, (4, -11, 14, -21)[index % 4]), "textcoords": "offset points"}
        axis.annotate(row.name.partition(" ")[2] or row.name, (x, max(y, FLOOR)), fontsize=7, **place)
    axis.set(xscale="log", yscale="log")
    axis.grid(which="major", alpha=0.3)


def _kind(row: Row) -> str:
    return row.name.split(" ")[0]
