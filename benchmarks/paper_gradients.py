"""Fig. 8 of docs/experiments.md: our derivative images beside differences of path-traced ones.

    python benchmarks/paper.py fig08

Every cell's density, or its absorption, changes by the same amount. Derivatives are taken in the
middle between two scenes that Mitsuba traces: the cloud as it is, and with a little more density
everywhere; for absorption, less and more. Pictures that are there already are not traced again.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from figures import as_options, ddrecon, print_header, print_row
from numpy.typing import NDArray
from paper_figures import (
    CONFIGS,
    PICTURES,
    SHAPES,
    Array,
    save,
    show,
    show_signed,
)

from ddrecon.io.volumes.table import read_field, write_field

matplotlib.use("Agg")
import matplotlib.pyplot as plt

CONFIG, CLOUD, PICTURE = CONFIGS / "fig08.yaml", SHAPES / "cloud.npz", PICTURES / "fig08.png"
PATHS = 8192
HAZE, ABSORPTION = 0.03, 1.0
"""Differences of density, and of sigma_a [1/u], between the two scenes that are traced."""
ENLARGED = 4
"""Errors are shown so many times brighter than the derivatives."""
MODELS = {
    "printed": ("diffusion.scheme=printed",),
    "0 rounds": ("diffusion.transport_rounds=0",),
    "2 rounds": ("diffusion.transport_rounds=2",),
}
"""The paper's own scheme, and ours without and with transport rounds, as overrides."""


@dataclass(frozen=True)
class Change:
    """The scenes `before`, `between` and `after` as overrides; `parameter` changes by `amount` in
    all, from the first to the last.
    """

    parameter: str
    amount: float
    before: str
    between: str
    after: str


def changes(folder: Path) -> list[Change]:
    """Both changes, with the volumes they need in `folder`."""
    cloud = read_field(CLOUD, "density")
    names = {"before": 0.0, "between": HAZE / 2, "after": HAZE}
    for name, haze in names.items():
        write_field(
            folder / f"{name}.npz", "density", cloud.values + np.float32(haze), cloud.bounds
        )
    hazy = [f"volume.density={{file: {(folder / f'{name}.npz').resolve()}}}" for name in names]
    return [
        Change("density", HAZE, *hazy),
        Change(
            "sigma_a",
            ABSORPTION,
            *(f"volume.sigma_a={1 + ABSORPTION * part}" for part in (-0.5, 0, 0.5)),
        ),
    ]


def trace_derivative(change: Change, folder: Path) -> tuple[Array, float]:
    """The derivative image [h, w] from path tracing, and the standard error of its pixels (root
    mean square).
    """
    pictures, variance = [], 0.0
    for name, override in (("before", change.before), ("after", change.after)):
        output = folder / f"{change.parameter}_{name}"
        if not (output / "reference.json").exists():
            ddrecon(
                "reference", CONFIG, "-o", output, "--views", "--spp", str(PATHS), "-D", override
            )
        picture = np.load(output / "front.npy").mean(-1)
        noise = json.loads((output / "reference.json").read_text())["views"]["front"]["noise"]
        variance += noise**2 * float((picture**2).mean())
        pictures.append(picture)
    return (pictures[1] - pictures[0]) / change.amount, variance**0.5 / change.amount


def differentiate(change: Change, folder: Path, model: str) -> Array:
    """The derivative [h, w] of the image by one of `MODELS`."""
    output = folder / f"{change.parameter}_{model[0]}"
    options = as_options([change.between, *MODELS[model]])
    ddrecon("render", CONFIG, "-o", output, "--gradient", change.parameter, *options)
    mean: Array = np.load(output / "front.gradient.npy").mean(-1)
    return mean


def regions(folder: Path) -> dict[str, NDArray[np.bool_]]:
    """Pixels [h, w] by what part of a light behind the cloud they would let through."""
    black = ["volume.sigma_s=0", "volume.sigma_a=12", "lights=[{type: ambient, radiance: 1}]"]
    ddrecon("render", CONFIG, "-o", folder / "through", *as_options(black))
    through = np.load(folder / "through" / "front.npy").mean(-1)
    return {
        "thick": through < 0.2,
        "thin": (through >= 0.2) & (through < 0.95),
        "empty": through >= 0.95,
    }


def relative_error(image: Array, truth: Array) -> float:
    """The root mean square error of `image` relative to `truth`, whose noise it includes."""
    return float(np.sqrt(((image - truth) ** 2).mean() / (truth**2).mean()))


def remake(folder: Path) -> None:
    """Draws the picture and prints the table."""
    folder = folder / "fig08"
    folder.mkdir(parents=True, exist_ok=True)
    seen, count = regions(folder), len(MODELS)
    print_header("by", "what", "noise", "error", "in the regions", "correlation")
    figure, axes = plt.subplots(2, 1 + 2 * count, figsize=(12, 4), layout="constrained")
    for row, change in zip(axes, changes(folder), strict=True):
        truth, noise = trace_derivative(change, folder)
        full = float(np.quantile(np.abs(truth), 0.99))
        row[0].set_ylabel(f"by {change.parameter}")
        show_signed(row[0], truth, full, "differences of\npath tracing")
        for column, name in enumerate(MODELS, 1):
            image = differentiate(change, folder, name)
            print_error(change, name, image, truth, noise, seen)
            show_signed(row[column], image, full, f"ours, {name}")
            away = row[column + count]
            show(away, np.abs(image - truth), full / ENLARGED, "inferno")
            words = f"{ENLARGED} x |error|,\nours, {name}: {relative_error(image, truth):.2f}"
            away.set_title(words, fontsize=8)
    save(figure, PICTURE)


def print_error(
    change: Change,
    name: str,
    image: Array,
    truth: Array,
    noise: float,
    seen: dict[str, NDArray[np.bool_]],
) -> None:
    """Prints a row: errors of `image`, and the `noise` there is in truth, or in it."""
    errors = ((region, relative_error(image[at], truth[at])) for region, at in seen.items())
    words = ", ".join(f"{region} {error:.3f}" for region, error in errors)
    alike = float(np.corrcoef(image.ravel(), truth.ravel())[0, 1])
    share = noise / float(np.sqrt((truth**2).mean()))
    print_row(change.parameter, name, share, relative_error(image, truth), words, alike)
