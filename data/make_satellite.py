"""Makes data/satellite: the cumuli of data/cumulus_field over bright ground, from five angles.

    python data/make_satellite.py

The pictures are ddrecon's own, of the field in its finer cells, with noise.
"""

from __future__ import annotations

from pathlib import Path

from noisy import write_pictures

ALBEDO = 0.3
"""Of the ground."""
TRUTH = (
    "volume.density={file: ../data/cumulus_field/density.npz}",
    "volume.resolution=[64, 64, 40]",
    f"ground.albedo={ALBEDO}",
)


def main() -> None:
    """Writes the pictures."""
    (Path(__file__).parent / "satellite").mkdir(exist_ok=True)
    write_pictures("satellite", noise=0.02, truth=TRUTH)


if __name__ == "__main__":
    main()
