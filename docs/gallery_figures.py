"""Makes a picture of docs/gallery.md from the folder of a run, and that of its `ddrecon render
--ring` or `--fluence`.

    ddrecon optimize configs/NAME.yaml -o runs/NAME
    ddrecon render runs/NAME -o runs/NAME_around --ring 8 --light '{...}'
    python docs/gallery_figures.py runs/NAME runs/NAME_around VIEW docs/pictures/gallery/NAME.png

Above: the target of VIEW, our render, their difference four times enlarged, and the slices of the
fields that were found. Below: the volume from around, or slices of the logarithm of its fluence.
"""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from ddrecon.report.pictures import slices

Picture = NDArray[np.uint8]
HEIGHT = 192
"""Pixels of a row."""
GAP = 6
FIELDS = ("density", "emission", "sigma_a")
FLUENCE, DECADES = "volumes/fluence.npz", 1
"""Where it lies, and how far below its largest value it is black."""


def scaled(picture: Picture) -> Picture:
    """`picture` about `HEIGHT` pixels high, by whole numbers of pixels."""
    height = picture.shape[0]
    if height < HEIGHT:
        return picture.repeat(round(HEIGHT / height), 0).repeat(round(HEIGHT / height), 1)
    factor = round(height / HEIGHT)
    rows, columns = (size // factor * factor for size in picture.shape[:2])
    means = (
        picture[:rows, :columns]
        .reshape(rows // factor, factor, columns // factor, factor, 3)
        .mean((1, 3))
    )
    return means.astype(np.uint8)


def row(pictures: list[Picture]) -> Picture:
    """`pictures` side by side."""
    height = max(picture.shape[0] for picture in pictures)
    padded = [
        np.pad(picture, ((0, height - picture.shape[0]), (0, GAP), (0, 0))) for picture in pictures
    ]
    return np.concatenate(padded, 1)


def column(rows: list[Picture]) -> Picture:
    """`rows` below each other."""
    width = max(part.shape[1] for part in rows)
    return np.concatenate(
        [np.pad(part, ((0, GAP), (0, width - part.shape[1]), (0, 0))) for part in rows], 0
    )


def main(run: Path, around: Path, view: str, output: Path) -> None:
    """Writes the picture."""
    sought = yaml.safe_load((run / "scene.yaml").read_text())["optimize"]["parameters"]
    names = [view, *(f"{name}.slices" for name in FIELDS if name in sought)]
    above = [iio.imread(run / "previews" / f"{name}.png")[..., :3] for name in names]
    if (around / FLUENCE).exists():
        fluence = np.load(around / FLUENCE)["fluence"]
        part = np.log10(np.maximum(fluence / fluence.max(), 10.0**-DECADES)) / DECADES + 1
        field = torch.from_numpy(part if part.ndim == 3 else np.moveaxis(part, -1, 0))
        below = [(255 * slices(field, white=1.0)).astype(np.uint8)]
    else:
        turned = iio.imread(around / "ring.png", index=..., plugin="pillow")[..., :3]
        below = [*turned[:5]]
    whole = column([row([scaled(picture) for picture in part]) for part in (above, below)])
    output.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(output, whole, optimize=True)


if __name__ == "__main__":
    run_folder, around_folder, name, path = sys.argv[1:]
    main(Path(run_folder), Path(around_folder), name, Path(path))
