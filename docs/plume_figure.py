"""Draws docs/plume.png, the picture in the README, from a finished run of configs/plume.yaml.

ddrecon optimize configs/plume.yaml -o runs/plume && python docs/plume_figure.py runs/plume
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from numpy.typing import NDArray

import ddrecon
from ddrecon.io.volumes.table import read_field
from ddrecon.pictures import srgb
from ddrecon.report.pictures import pixels

ROOT = Path(__file__).parents[1]
VIEW = "test_10"


def pictures(run: Path) -> list[tuple[str, NDArray[np.float32]]]:
    """Target, render of the reconstruction and of a relit one, in linear radiance, each scaled to
    its brightest pixels.
    """
    density = f"volume.density={{file: {(run / 'volumes' / 'density.npz').resolve()}}}"
    scene = ddrecon.load_scene(run / "scene.yaml", overrides=[density])
    relit = ddrecon.load_scene(
        run / "scene.yaml", overrides=[density, "lights.0.direction=[2, -1, 1]"]
    )
    target = scene.view(VIEW).image
    with torch.no_grad():
        images = [target, ddrecon.render(scene, VIEW)[0], ddrecon.render(relit, VIEW)[0]]
    titles = [
        "held-out picture\n(path-traced)",
        "our render of\nthe reconstruction",
        "the same, lit from\nthe other side",
    ]
    return [
        (title, pixels(image) / np.quantile(pixels(image), 0.999))
        for title, image in zip(titles, images, strict=True)
    ]


def slices(run: Path) -> list[tuple[str, NDArray[np.float32]]]:
    """The middle slice across z of the reconstructed and of the true density, y upwards."""
    files = [
        ("reconstructed density,\nmiddle slice", run / "volumes" / "density.npz"),
        ("true density", ROOT / "data" / "plume" / "density.npz"),
    ]
    fields = [(title, read_field(path, "density").values) for title, path in files]
    return [(title, values[values.shape[0] // 2, ::-1]) for title, values in fields]


def main() -> None:
    """Writes docs/plume.png."""
    run = Path(sys.argv[1])
    figure, axes = plt.subplots(1, 5, figsize=(12, 3.1))
    for axis, (title, picture) in zip(axes, pictures(run), strict=False):
        axis.imshow(srgb.encode(np.clip(picture, 0, 1)))
        axis.set_title(title, fontsize=9)
    for axis, (title, field) in zip(axes[3:], slices(run), strict=True):
        axis.imshow(field, cmap="gray", vmin=0, vmax=1)
        axis.set_title(title, fontsize=9)
    for axis in axes:
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(ROOT / "docs" / "plume.png", dpi=100)


if __name__ == "__main__":
    main()
