"""How far what `ddrecon optimize configs/capture.yaml -o RUN_DIR` found is from what is true.

python benchmarks/capture.py RUN_DIR [RUN_DIR ...]

Density, lamp, exposures and cameras, and first cameras as they were told.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from ddrecon.io.volumes.table import read_field

FOLDER = Path(__file__).parents[1] / "data/capture"
LAMP = (7.3, 7.0, 6.4)


def rotation_between(found: np.ndarray, true: np.ndarray) -> float:
    """The angle [degrees] by which the poses [3, 4] `found` and `true` are turned."""
    chord = np.linalg.norm(found[:, :3] - true[:, :3]) / 8**0.5
    return float(np.degrees(2 * np.arcsin(min(chord, 1))))


def angles_between_rays(found: np.ndarray, true: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far `points` [n, 3] are from where they are seen [degrees], as the camera sees them."""
    seen = []
    for pose in (found, true):
        places = (points - pose[:, 3]) @ pose[:, :3]
        seen.append(places / np.linalg.norm(places, axis=1, keepdims=True))
    return np.degrees(np.linalg.norm(np.cross(*seen), axis=1))


def print_cameras(poses: dict[str, Any], frames: list[dict[str, Any]], smoke: Any) -> None:
    """Prints how far the `poses` by name are from those of `frames`, at the `smoke`.

    That is points [n, 3] and their weights [n].
    """
    turned, away, pixels = [], [], []
    for frame in frames:
        name = Path(frame["file_path"]).stem
        found, true = (np.array(m)[:3] for m in (poses[name], frame["transform_matrix"]))
        angle = float(angles_between_rays(found, true, smoke[0]) @ smoke[1])
        turned.append(rotation_between(found, true))
        away.append(angle)
        pixels.append(np.radians(angle) * frame["fl_x"])
    for what, values in (("turned [degrees]", turned), ("rays [degrees]", away), ("", pixels)):
        print(f"  {what or 'rays [pixels]'}:", " ".join(f"{value:.3f}" for value in values))


def main() -> None:
    """Prints a few lines for each run."""
    parser = argparse.ArgumentParser()
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN_DIR")
    given = parser.parse_args()
    truth, told = (
        json.loads((FOLDER / name).read_text())["frames"]
        for name in ("truth.json", "transforms.json")
    )
    field, frames = read_field(FOLDER / "density.npz", "density"), truth[:-1]
    density = field.values.astype(np.float64)
    # Where there is smoke, and how much.
    low, high = np.load(FOLDER / "density.npz")["bounds"]
    places = np.argwhere(density > 0)
    weights = density[density > 0] / density.sum()
    points = low + (places[:, ::-1] + 0.5) / density.shape[::-1] * (high - low)
    print("told")
    poses = {Path(frame["file_path"]).stem: frame["transform_matrix"] for frame in told}
    print_cameras(poses, frames, (points, weights))
    for run in given.runs:
        found = read_field(run / "volumes" / "density.npz", "density").values.astype(np.float64)
        parts = [(n, m // n) for n, m in zip(found.shape, density.shape, strict=True)]
        true = density.reshape([n for pair in parts for n in pair]).mean((1, 3, 5))
        summary, values = (
            json.loads((run / name).read_text()) for name in ("summary.json", "parameters.json")
        )
        print(
            f"{run}: {summary['seconds']:.0f} s, held out {summary['test_psnr']:.2f} dB,"
            f" L1 {np.abs(found - true).sum() / true.sum():.3f}"
        )
        if "lights.0.irradiance" in values:
            print("  lamp, part of the true:", np.divide(values["lights.0.irradiance"], LAMP))
        if "views.cam_0.exposure" in values:
            gains = [values[f"views.{Path(f['file_path']).stem}.exposure"] for f in frames]
            off = 100 * np.abs(np.divide(gains, [f["exposure"] for f in frames]) - 1)
            print(f"  exposures off [%]: {off.mean():.2f} on average, {off.max():.2f} at worst")
        if "views.cam_0.camera" in values:
            names = [Path(frame["file_path"]).stem for frame in frames]
            poses = {name: values[f"views.{name}.camera"]["matrix"] for name in names}
            print_cameras(poses, frames, (points, weights))


if __name__ == "__main__":
    main()
