"""Fig. 8 of docs/experiments.md: our derivative images beside differences of path-traced ones.

    python benchmarks/paper.py fig08

Every cell's density, or its absorption, changes by the same amount. Derivatives are taken in the
middle between two scenes that Mitsuba traces: the cloud as it is, and with a little more density
everywhere; for absorption, less and more. Pictures that are there already are not traced again.
"""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from figures import as_options, ddrecon, print_header, print_row
from numpy.typing import NDArray
from paper_figures import CONFIGS, PICTURES, SHAPES, Array, save, show, show_signed

from ddrecon.io.volumes.table import read_field, write_field

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


Change = tuple[str, float, list[str]]
"""A parameter, the amount by which it changes in all, and overrides: before, between and after."""


def changes(folder: Path) -> list[Change]:
    """Both changes, with the volumes they need in `folder`."""
    cloud, hazy = read_field(CLOUD, "density"), []
    for part in (0, 0.5, 1):
        path = (folder / f"{part}.npz").resolve()
        write_field(path, "density", cloud.values + np.float32(part * HAZE), cloud.bounds)
        hazy.append(f"volume.density={{file: {path}}}")
    black = [f"volume.sigma_a={1 + part * ABSORPTION}" for part in (-0.5, 0, 0.5)]
    return [("density", HAZE, hazy), ("sigma_a", ABSORPTION, black)]


def trace_derivative(change: Change, folder: Path) -> tuple[Array, float]:
    """The derivative image [h, w] from path tracing, and the standard error of its pixels (root
    mean square).
    """
    parameter, amount, (before, _, after) = change
    pictures, variance = [], 0.0
    for name, override in (("before", before), ("after", after)):
        output = folder / f"{parameter}_{name}"
        if not (output / "reference.json").exists():
            options = "--views", "--spp", str(PATHS), "-D", override
            ddrecon("reference", CONFIG, "-o", output, *options)
        picture = np.load(output / "front.npy").mean(-1)
        noise = json.loads((output / "reference.json").read_text())["views"]["front"]["noise"]
        variance += noise**2 * float((picture**2).mean())
        pictures.append(picture)
    return (pictures[1] - pictures[0]) / amount, variance**0.5 / amount


def differentiate(change: Change, folder: Path, model: str) -> Array:
    """The derivative [h, w] of the image by one of `MODELS`."""
    parameter, _, (_, between, _) = change
    output = folder / f"{parameter}_{model[0]}"
    options = as_options([between, *MODELS[model]])
    ddrecon("render", CONFIG, "-o", output, "--gradient", parameter, *options)
    return np.load(output / "front.gradient.npy").mean(-1)


def regions(folder: Path) -> dict[str, NDArray[np.bool_]]:
    """Pixels [h, w] by what part of a light behind the cloud they would let through."""
    black = ["volume.sigma_s=0", "volume.sigma_a=12", "lights=[{type: ambient, radiance: 1}]"]
    ddrecon("render", CONFIG, "-o", folder / "through", *as_options(black))
    through = np.load(folder / "through" / "front.npy").mean(-1)
    thick, empty = through < 0.2, through >= 0.95
    return {"thick": thick, "thin": ~thick & ~empty, "empty": empty}


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
        row[0].set_ylabel(f"by {change[0]}")
        show_signed(row[0], truth, full, "differences of\npath tracing")
        for column, name in enumerate(MODELS, 1):
            image = differentiate(change, folder, name)
            errors = (f"{at} {relative_error(image[m], truth[m]):.3f}" for at, m in seen.items())
            share = noise / float(np.sqrt((truth**2).mean()))
            alike = float(np.corrcoef(image.ravel(), truth.ravel())[0, 1])
            error = relative_error(image, truth)
            print_row(change[0], name, share, error, ", ".join(errors), alike)
            show_signed(row[column], image, full, f"ours, {name}")
            away = row[column + count]
            show(away, np.abs(image - truth), full / ENLARGED, "inferno")
            words = f"{ENLARGED} x |error|,\nours, {name}: {error:.2f}"
            away.set_title(words, fontsize=8)
    save(figure, PICTURE)
