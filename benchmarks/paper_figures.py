"""What the experiments of docs/experiments.md share: commands, and their pictures.

A picture has truth, ours, the absolute difference, and what a run took. Arrays are [h, w] or [h, w,
3].
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from figures import ROOT
from numpy.typing import NDArray
from PIL import Image

from ddrecon.pictures import encode

matplotlib.use("Agg")
import matplotlib.pyplot as plt

Array = NDArray[np.float32]
Log = Mapping[str, NDArray[np.float64]]
CONFIGS, SHAPES, PICTURES = (
    ROOT / place for place in ("configs/paper", "data/shapes", "docs/pictures/paper")
)
COLORS = 192
"""Colors of a picture's file."""


@dataclass(frozen=True)
class Pair:
    """What should look alike: pictures in linear radiance or maps of a quantity; `truth` is None
    where nobody knows it.
    """

    title: str
    truth: Array | None
    ours: Array

    @property
    def white(self) -> float:
        """The value shown brightest."""
        return max(float(np.quantile(self.ours if self.truth is None else self.truth, 0.999)), 1e-6)


def read_log(run: Path) -> Log:
    """The columns of the log of `run` by name; NaN where an entry is empty."""
    with (run / "loss.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


def pace(log: Log) -> NDArray[np.float64]:
    """Seconds of each iteration."""
    return np.diff(log["seconds"], prepend=0.0)


def project(field: Array, axis: int, side: float) -> Array:
    """The integral of `field` [z, y, x] along `axis` (0 or 2) across a box of that `side` [u], y
    upwards.
    """
    total = field.sum(axis) * (side / field.shape[axis])
    return (total if axis == 0 else total.T)[::-1]


def draw(path: Path, pairs: Sequence[Pair], logs: Mapping[str, Log]) -> None:
    """Writes a PNG: a column for each of `pairs`, and below them loss, solves and time of each run
    in `logs`, if there are any.
    """
    figure = plt.figure(
        figsize=(max(2.1 * len(pairs), 8), 8.6 if logs else 6.4), layout="constrained"
    )
    upper, lower = figure.subfigures(2, 1, height_ratios=(3, 1.15)) if logs else (figure, figure)
    axes = upper.subplots(3, len(pairs), squeeze=False)
    for column, pair in zip(axes.T, pairs, strict=True):
        _draw_pair(column, pair)
    for axis, name in zip(axes[:, 0], ("reference", "ours", "|difference|"), strict=True):
        axis.set_ylabel(name, fontsize=9)
    if logs:
        _draw_logs(lower.subplots(1, 3), logs)
    save(figure, path)


def show_signed(axis: Any, values: Array, full: float, title: str) -> None:
    """Draws a signed map on `axis`: white is 0, red is `full`, blue minus that."""
    axis.imshow(values, cmap="RdBu_r", vmin=-full, vmax=full)
    axis.set(xticks=[], yticks=[])
    axis.set_title(title, fontsize=8)


def save(figure: Any, path: Path) -> None:
    """Writes `figure` as a PNG of few colors and closes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=75)
    plt.close(figure)
    Image.open(drawn).convert("RGB").quantize(COLORS, kmeans=1).save(path, optimize=True)


def _draw_pair(column: Sequence[Any], pair: Pair) -> None:
    column[0].set_title(pair.title, fontsize=8)
    for axis, values in zip(column, (pair.truth, pair.ours), strict=False):
        show(axis, values, pair.white)
    difference = None if pair.truth is None else np.abs(pair.ours - pair.truth)
    if difference is not None and difference.ndim == 3:
        difference = difference.mean(-1)
    full = None if difference is None else max(float(np.quantile(difference, 0.999)), 1e-6)
    show(column[2], difference, full or 1.0, "inferno")
    if full is not None:
        column[2].set_xlabel(f"to {full:.2g}; white above: {pair.white:.2g}", fontsize=7)


def show(axis: Any, values: Array | None, white: float, colors: str = "viridis") -> None:
    """Draws a picture in linear radiance, or a map of a quantity in `colors`, on `axis` without
    ticks; nothing where there is none.
    """
    axis.set(xticks=[], yticks=[])
    if values is None:
        axis.axis("off")
    elif values.ndim == 3:
        axis.imshow(encode(np.clip(values / white, 0, 1)))
    else:
        axis.imshow(values, cmap=colors, vmin=0, vmax=white)


def _draw_logs(axes: Sequence[Any], logs: Mapping[str, Log]) -> None:
    for index, (name, log) in enumerate(logs.items()):
        color, label, at = f"C{index}", name if len(logs) > 1 else "", log["iteration"]
        axes[0].semilogy(at, log["loss"], color=color, label=label)
        for kind, style in (("forward", "-"), ("adjoint", ":")):
            words = f"{label} {kind}".strip()
            axes[1].plot(at, log[f"{kind}_iterations"], color=color, linestyle=style, label=words)
        axes[2].plot(at, pace(log), color=color, label=label)
    titles = ("loss", "iterations of the solves", "seconds an iteration")
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=7)
        axis.set_xlabel("iteration", fontsize=7)
    axes[1].legend(fontsize=6)
    axes[2].set_ylim(bottom=0)
    if len(logs) > 1:
        axes[0].legend(fontsize=6)
