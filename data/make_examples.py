"""Makes data/cumulus_field and data/smoke_sky: a cloud field and a sky, and the path-traced
pictures that two configs reconstruct from.

    python data/make_examples.py SKY.exr [NAME]... [--threads 2]

SKY.exr is `sky_cc0.exr`, an environment map of 512 x 256 pixels; of it the means of 8 x 8 pixels
are kept. Pictures are traced by Mitsuba 3 through `ddrecon reference` and kept as float16, whose
rounding is far below their noise.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from make_shapes import centers, smooth_step, swirl, write
from make_targets import keep

from ddrecon.io.images.table import read_image

ROOT = Path(__file__).parents[1]
FIELD, SKY = ROOT / "data" / "cumulus_field", ROOT / "data" / "smoke_sky"
BOX = np.array([[0.0, 0.0, 0.5], [1.28, 1.28, 1.3]])
"""The field's box [km], z up; clouds have their base at 0.56 km."""
CELLS = (64, 64, 40)
CLOUDS = [
    (0.42, 0.5, 0.26, 0.52),
    (0.86, 0.72, 0.2, 0.4),
    (0.62, 1.02, 0.13, 0.22),
    (0.95, 0.3, 0.12, 0.2),
]
"""x, y, radius and height of each [km]."""

TRUTHS = {
    "cumulus_field": "../data/cumulus_field/density.npz",
    "smoke_sky": "../data/shapes/smoke.npz",
}
"""The density of each config in truth."""
PATHS = 256
"""Paths a pixel."""


def field() -> None:
    """Writes the extinction, in units of its largest value, of four cumuli: liquid water grows with
    height above a flat base, as it does in air that rises without mixing (see e.g.
    doi:10.1175/JAS-D-13-0306.1), and tops are folded by curl noise.
    """
    points = centers(BOX, CELLS)
    height = points[..., 2] - 0.56
    folded = swirl(points * 2.5, 5, 0.22) / 2.5
    density = np.zeros(points.shape[:-1])
    for x, y, radius, top in CLOUDS:
        middle = np.array([x, y, 0.56 + 0.35 * top])
        scaled = (folded - middle) / (radius, radius, 0.62 * top)
        inside = smooth_step(np.linalg.norm(scaled, axis=-1) - 1, 0.05)
        density = np.maximum(density, inside * np.clip(height / 0.4, 0.15, 1) ** (2 / 3))
    FIELD.mkdir(exist_ok=True)
    write(FIELD / "density.npz", BOX, density=density * smooth_step(-height, 0.008))


def sky(source: Path) -> None:
    """Writes the small sky."""
    pixels = read_image(source).pixels
    SKY.mkdir(exist_ok=True)
    np.save(SKY / "sky.npy", pixels.reshape(32, 8, 64, 8, 3).mean((1, 3)).astype(np.float16))


def targets(name: str, threads: int) -> None:
    """Path-traces the views of the config `name` as they are in truth."""
    scene = ROOT / "configs" / f"{name}.yaml"
    count = scene.read_text().count("image:")
    options = [part for index in range(count) for part in ("-D", f"views.{index}.image=")]
    options += [
        "-D",
        f"volume.density={{file: {TRUTHS[name]}}}",
        "--spp",
        str(PATHS),
        "--threads",
        str(threads),
    ]
    with tempfile.TemporaryDirectory() as traced:
        subprocess.run(
            ["ddrecon", "reference", scene, "-o", traced, "--overwrite", "--views", *options],
            check=True,
        )
        keep(Path(traced), ROOT / "data" / name)


def main() -> None:
    """Writes all of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sky", type=Path, help="sky_cc0.exr")
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"one of {', '.join(TRUTHS)}; all unless given"
    )
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    field()
    sky(given.sky)
    for name in given.names or TRUTHS:
        targets(name, given.threads)


if __name__ == "__main__":
    main()
