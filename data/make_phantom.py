"""Makes data/phantom: the absorption of a phantom of tissue, 20 mm wide, and eight pictures of it.

python data/make_phantom.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from noisy import write_pictures

from ddrecon.io.volumes.table import write_field

CELLS, SIDE = 32, 20.0
"""Along each side, and the side [mm]."""
TISSUE, ABSORBER = 0.01, 0.1
"""Absorption coefficients [1/mm]."""
PLACE, RADIUS = (2.0, 3.0, 0.0), 3.0
"""Of the absorber, from the middle of the phantom (x, y, z) [mm]."""
FINER = 8
"""Samples along each side of a cell, of which the absorber takes its part."""


def main() -> None:
    line = ((np.arange(CELLS * FINER) + 0.5) / (CELLS * FINER) - 0.5) * SIDE
    z, y, x = np.meshgrid(line, line, line, indexing="ij", sparse=True)
    is_inside = (x - PLACE[0]) ** 2 + (y - PLACE[1]) ** 2 + (z - PLACE[2]) ** 2 < RADIUS**2
    part = is_inside.reshape(CELLS, FINER, CELLS, FINER, CELLS, FINER).mean((1, 3, 5))
    half = SIDE / 2
    bounds = np.array([[-half] * 3, [half] * 3])
    folder = Path(__file__).parent / "phantom"
    folder.mkdir(exist_ok=True)
    write_field(folder / "sigma_a.npz", "sigma_a", TISSUE + (ABSORBER - TISSUE) * part, bounds)
    write_pictures(
        "phantom", noise=0.005, truth=["volume.sigma_a={file: ../data/phantom/sigma_a.npz}"]
    )


if __name__ == "__main__":
    main()
