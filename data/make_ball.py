"""Makes data/ball: a soft ball on 16^3 cells, and its pictures from six training views and one test
view.

The pictures are ddrecon's own, so that a reconstruction can be judged against a known volume. Run
it from the repository's root: `python data/make_ball.py`, with ddrecon installed.
"""

from pathlib import Path

import numpy as np
import torch

import ddrecon
from ddrecon.io.images.table import write_linear
from ddrecon.io.volumes.table import write_field
from ddrecon.report.pictures import pixels

CELLS = 16
FOLDER = Path(__file__).parent / "ball"


def soft_ball() -> np.ndarray:
    """Density [z, y, x] of a ball of radius 0.35 u whose surface is smoothed over 0.08 u, brighter
    towards +x.
    """
    line = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    z, y, x = np.meshgrid(line, line, line, indexing="ij")
    radius = np.sqrt(x**2 + y**2 + z**2)
    return (1 + x) / (1 + np.exp((radius - 0.35) / 0.04))


def main() -> None:
    """Writes the volume and the pictures."""
    FOLDER.mkdir(exist_ok=True)
    write_field(FOLDER / "density.npz", "density", soft_ball(), np.array([[-0.5] * 3, [0.5] * 3]))
    scene = ddrecon.load_scene(FOLDER / "truth.yaml", dtype=torch.float64)
    with torch.no_grad():
        images = ddrecon.render(scene)
    for view, image in zip(scene.views, images, strict=True):
        for path in write_linear(FOLDER / view.name, pixels(image)):
            if path.suffix != ".npy":
                path.unlink()


if __name__ == "__main__":
    main()
