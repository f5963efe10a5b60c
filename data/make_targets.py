"""Makes data/paper: the pictures that configs/paper reconstructs from, path-traced by Mitsuba 3
through `ddrecon reference`.

    python data/make_targets.py [NAME]... [--pixels 512] [--paths 1024] [--threads 2] [-o FOLDER]

NAME is that of a folder in data/paper. Pictures are kept as float16, whose rounding is far below their noise. Without --pixels and
--paths they are as those shipped, noise included.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

ROOT = Path(__file__).parents[1]
FOLDER = Path(__file__).parent / "paper"
BUNNY, KNOT, CLOUD, SMOKE = (
    f"{{file: ../../data/shapes/{name}.npz}}" for name in ("bunny", "knot", "cloud", "smoke")
)


@dataclass(frozen=True)
class Truth:
    """The scene of `config` as it is in truth, by `overrides`; its pictures have `pixels` along
    each side, of `paths` each.
    """

    config: str
    overrides: tuple[str, ...]
    pixels: int
    paths: int


TRUTHS = {
    "fig06_light": Truth("fig06_light", ("lights.0.irradiance=[3.2, 2.1, 1.2]",), 96, 512),
    "fig07": Truth("fig07", (f"volume.density={CLOUD}",), 96, 512),
    "fig10": Truth(
        "fig10", (f"volume.sigma_a={CLOUD}", f"volume.sigma_s={CLOUD}", "volume.g=-0.802"), 64, 512
    ),
    "fig13": Truth("fig13", (f"volume.density={BUNNY}",), 96, 256),
    "knot": Truth("fig06_density", (f"volume.density={KNOT}",), 128, 512),
    "smoke": Truth(
        "fig12_single",
        tuple(f"volume.{name}={SMOKE}" for name in ("density", "sigma_a", "sigma_s")),
        96,
        512,
    ),
}


def reference(truth: Truth, pixels: int, paths: int, threads: int | None, output: Path) -> None:
    """Path-traces every view of `truth` into the folder `output`, on so many `threads` (None: all)."""
    config = ROOT / "configs" / "paper" / f"{truth.config}.yaml"
    count = len(yaml.safe_load(config.read_text())["views"])
    sizes = [f"views.{index}.camera.resolution=[{pixels}, {pixels}]" for index in range(count)]
    overrides = [*truth.overrides, *(f"views.{index}.image=" for index in range(count)), *sizes]
    options = [part for override in overrides for part in ("-D", override)] + (
        [] if threads is None else ["--threads", str(threads)]
    )
    subprocess.run(
        [
            "ddrecon",
            "reference",
            config,
            "-o",
            output,
            "--views",
            "--spp",
            str(paths),
            "-q",
            *options,
        ],
        check=True,
    )


def keep(traced: Path, folder: Path) -> None:
    """Keeps the pictures in the folder `traced` as float16 arrays; the smoke's also mirrored, for
    the views from left and right.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(traced.glob("*.npy")):
        picture = np.load(path).astype(np.float16)
        np.save(folder / path.name, picture)
        if (folder.name, path.stem) == ("smoke", "front"):
            np.save(folder / "mirrored.npy", picture[:, ::-1])


def main() -> None:
    """Writes the pictures of the named truths, or of all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(TRUTHS)}")
    parser.add_argument("--pixels", type=int)
    parser.add_argument("--paths", type=int)
    parser.add_argument("--threads", type=int)
    parser.add_argument("-o", "--output", type=Path, default=FOLDER)
    given = parser.parse_args()
    for name in given.names or TRUTHS:
        truth = TRUTHS[name]
        with tempfile.TemporaryDirectory() as traced:
            reference(
                truth,
                given.pixels or truth.pixels,
                given.paths or truth.paths,
                given.threads,
                Path(traced),
            )
            keep(Path(traced), given.output / name)


if __name__ == "__main__":
    main()
