"""The picture of a bench: error against time, each kind of variant in its own color."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ddrecon.bench.report import Row, error_of


def draw(rows: Sequence[Row], path: Path) -> None:
    """Writes a PNG: the time of an image against its error, and of an image with its gradient against the gradient's numerical error.

    Raises ModuleNotFoundError where matplotlib is not installed.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    has_truth = any(row.image_error is not None for row in rows)
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5.5), layout="constrained")
    factors = list(dict.fromkeys(_factor(row) for row in rows))
    for factor in factors:
        chosen = [row for row in rows if _factor(row) == factor]
        color = f"C{factors.index(factor) % 10}"
        for axis, seconds, error in (
            (left, [row.image_seconds for row in chosen], [error_of(row) for row in chosen]),
            (right, [row.both_seconds for row in chosen], [row.gradient_numerical for row in chosen]),
        ):
            axis.scatter(seconds, [max(value, FLOOR) for value in error], color=color, label=factor, s=36, zorder=3)
    for row in rows:
        left.annotate(row.name.partition(" ")[2] or row.name, (row.image_seconds, max(error_of(row), FLOOR)), **NOTE)
        right.annotate(row.name.partition(" ")[2] or row.name, (row.both_seconds, max(row.gradient_numerical, FLOOR)), **NOTE)
    front = sorted((row.image_seconds, max(error_of(row), FLOOR)) for row in rows if row.is_best)
    left.step(*zip(*front, strict=True), where="post", color="0.6", linewidth=1, zorder=1)
    left.set(xlabel="seconds of an image", ylabel="relative RMS error, " + ("path tracing" if has_truth else "exact solution"))
    right.set(xlabel="seconds of an image and its gradient", ylabel="relative RMS error of the gradient, same model solved exactly")
    for axis in (left, right):
        axis.set(xscale="log", yscale="log")
        axis.grid(which="major", alpha=0.3)
    left.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


FLOOR = 1e-8
"""Errors below this are drawn here."""
NOTE = {"fontsize": 7, "xytext": (4, 3), "textcoords": "offset points"}


def _factor(row: Row) -> str:
    return row.name.split(" ")[0]
