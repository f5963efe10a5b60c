"""Makes data/fire: a fire and its smoke on 32 x 48 x 32 cells, and their pictures.

    python data/make_fire.py

A flame is a folded cone, the hotter the further within; its light is that of a black body. The
pictures are ddrecon's own, of more rounds and angles than a reconstruction takes, with noise.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from make_shapes import Array, centers, smooth_step, swirl, write
from noisy import write_pictures

from ddrecon.medium.optics import black_body_radiance

FOLDER = Path(__file__).parent / "fire"
BOX = np.array([[-0.5, -0.75, -0.5], [0.5, 0.75, 0.5]])
CELLS = (32, 48, 32)
SEED = 7


def fire(points: Array) -> tuple[Array, Array]:
    """Density [z, y, x] of soot and smoke, and emission [z, y, x, 3], at `points` (x, y, z)."""
    x, y, z = np.moveaxis(swirl(points, SEED, 0.12), -1, 0)
    height = np.clip((y + 0.68) / 1.36, 0, 1)
    radius = np.hypot(x, z)
    # The column of smoke widens as it rises; flames narrow to nothing at half the height.
    smoke = smooth_step(radius - (0.07 + 0.27 * height), 0.03) * smooth_step(height - 0.92, 0.03)
    smoke *= 0.08 + 0.92 * smooth_step(0.42 - height, 0.06)
    width = 0.2 * np.clip(1 - height / 0.55, 0, 1) ** 0.6
    flame = np.clip(1.15 - radius / np.maximum(width, 1e-3), 0, 1)
    flame *= smooth_step(0.06 - height, 0.02)
    light = black_body_radiance(torch.from_numpy(1350 + 800 * flame)).movedim(0, -1).numpy()
    return smoke, 0.25 * light * (flame**1.5)[..., None]


def main() -> None:
    """Writes the volume and the pictures."""
    FOLDER.mkdir(exist_ok=True)
    density, emission = fire(centers(BOX, CELLS))
    write(FOLDER / "fire.npz", BOX, density=density, emission=emission)
    write_pictures("fire", noise=0.03)


if __name__ == "__main__":
    main()
