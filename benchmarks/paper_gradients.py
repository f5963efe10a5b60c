"""Fig. 8 of docs/experiments.md: our derivative images beside differences of path-traced ones.

    python benchmarks/paper_gradients.py [-o FOLDER] [--paths 16384]

Every cell's density, or its absorption, changes by the same amount. Derivatives are taken in the middle between two scenes that Mitsuba
traces: the cloud as it is, and with a little more density everywhere; for absorption, less and more. Pictures that are there already are
not traced again.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray
from paper import as_options, ddrecon
from paper_figures import Array, save, show

from ddrecon.io.volumes import read_field, write_field

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "configs" / "paper" / "fig08.yaml"
CLOUD = ROOT / "data" / "shapes" / "cloud.npz"
PICTURE = ROOT / "docs" / "pictures" / "paper" / "fig08.png"
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
    """The scenes `before`, `between` and `after` as overrides; `parameter` changes by `amount` in all, from the first to the last."""

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
        write_field(folder / f"{name}.npz", "density", cloud.values + np.float32(haze), cloud.bounds)
    hazy = [f"volume.density={{file: {(folder / f'{name}.npz').resolve()}}}" for name in names]
    return [
        Change("density", HAZE, *hazy),
        Change("sigma_a", ABSORPTION, *(f"volume.sigma_a={1 + ABSORPTION * part}" for part in (-0.5, 0, 0.5))),
    ]


def traced(change: Change, folder: Path, paths: int) -> tuple[Array, float]:
    """The derivative image [h, w] from path tracing, and the standard error of its pixels (root mean square)."""
    pictures, variance = [], 0.0
    for name, override in (("before", change.before), ("after", change.after)):
        output = folder / f"{change.parameter}_{name}"
        if not (output / "reference.json").exists():
            ddrecon("reference", CONFIG, "-o", output, "--views", "--spp", str(paths), "-D", override)
        picture = np.load(output / "front.npy").mean(-1)
        noise = json.loads((output / "reference.json").read_text())["views"]["front"]["noise"]
        variance += noise**2 * float((picture**2).mean())
        pictures.append(picture)
    return (pictures[1] - pictures[0]) / change.amount, variance**0.5 / change.amount


def ours(change: Change, folder: Path, model: str) -> Array:
    """Our derivative image [h, w] by one of `MODELS`."""
    output = folder / f"{change.parameter}_{model[0]}"
    ddrecon("render", CONFIG, "-o", output, "--gradient", change.parameter, *as_options([change.between, *MODELS[model]]))
    derivative: Array = np.load(output / "front.gradient.npy").mean(-1)
    return derivative


def regions(folder: Path) -> dict[str, NDArray[np.bool_]]:
    """Pixels [h, w] by what part of a light behind the cloud they would let through."""
    black = ["volume.sigma_s=0", "volume.sigma_a=12", "lights=[{type: ambient, radiance: 1}]"]
    ddrecon("render", CONFIG, "-o", folder / "through", *as_options(black))
    through = np.load(folder / "through" / "front.npy").mean(-1)
    return {"thick": through < 0.2, "thin": (through >= 0.2) & (through < 0.95), "empty": through >= 0.95}


def relative(image: Array, truth: Array) -> float:
    """The root mean square error of `image` relative to `truth`, whose noise it includes."""
    return float(np.sqrt(((image - truth) ** 2).mean() / (truth**2).mean()))


def main() -> None:
    """Draws the picture and prints the errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "paper" / "fig08")
    parser.add_argument("--paths", type=int, default=16384)
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    seen = regions(given.output)
    figure, axes = plt.subplots(2, 7, figsize=(12, 4), layout="constrained")
    for row, change in zip(axes, changes(given.output), strict=True):
        truth, noise = traced(change, given.output, given.paths)
        size = np.sqrt((truth**2).mean())
        full = float(np.quantile(np.abs(truth), 0.99))
        row[0].set_ylabel(f"by {change.parameter}")
        _signed(row[0], truth, full, f"path tracing,\nnoise {noise / size:.2f}")
        for model, axis, error_axis in zip(MODELS, row[1:4], row[4:], strict=True):
            image = ours(change, given.output, model)
            parts = {name: relative(image[region], truth[region]) for name, region in seen.items()}
            _signed(axis, image, full, f"ours, {model}")
            show(error_axis, np.abs(image - truth), full / ENLARGED, "inferno")
            error_axis.set_title(f"{ENLARGED} x |error|, {model}:\n{relative(image, truth):.2f}", fontsize=8)
            error, alike = relative(image, truth), np.corrcoef(image.ravel(), truth.ravel())[0, 1]
            told = ", ".join(f"{name} {part:.3f}" for name, part in parts.items())
            print(f"| {change.parameter} | {model} | {noise / size:.3f} | {error:.3f} | {told} | {alike:.3f} |")
    save(figure, PICTURE)


def _signed(axis: plt.Axes, values: Array, full: float, title: str) -> None:
    axis.imshow(values, cmap="RdBu_r", vmin=-full, vmax=full)
    axis.set(xticks=[], yticks=[])
    axis.set_title(title, fontsize=8)


if __name__ == "__main__":
    main()
