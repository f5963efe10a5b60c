"""Draws docs/pictures/uncertainty.png from a folder of `ddrecon uncertainty` of the ball.

python docs/uncertainty_figure.py runs/ball_sure
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt

from ddrecon.io.volumes.table import read_field

ROOT = Path(__file__).parents[1]
KINDS = {"mean": "what was found", "std": "deviation"}


def main() -> None:
    """The middle slices across z, y upwards."""
    folder = Path(sys.argv[1])
    figure, axes = plt.subplots(1, len(KINDS), figsize=(6, 2.8))
    for axis, (kind, title) in zip(axes, KINDS.items(), strict=True):
        values = read_field(folder / "volumes" / f"density_{kind}.npz", f"density_{kind}").values
        shown = axis.imshow(values[len(values) // 2, ::-1], cmap="gray", vmin=0)
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()
        figure.colorbar(shown, ax=axis, shrink=0.7)
    figure.tight_layout()
    figure.savefig(ROOT / "docs" / "pictures" / "uncertainty.png", dpi=110)


if __name__ == "__main__":
    main()
