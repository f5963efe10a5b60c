"""What reconstructions come to: of the plume by settings; of the capture also exposures, lamp and
cameras; of the first frames of the film how the last of them is alone as well.

    python benchmarks/reconstruction.py plume|capture|film [-o FOLDER]

Every run is a process of its own, `ddrecon optimize`. Tables are Markdown. Runs are left in FOLDER.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from figures import ROOT, Used, as_options, ddrecon, print_header, print_row
from inverse import CONFIGS, measure, print_measured
from inverse_scenes import coarsened

from ddrecon.io.volumes.table import read_field

CAPTURE, FILM = ROOT / "data/capture", ROOT / "data/film"
LAMP, SUN = (7.3, 7.0, 6.4), (0.8, -0.45, -0.4)
"""Irradiance and direction of the light by which pictures of the capture and film were made."""
SHIFT = "where cameras see the smoke [pixels]"
FRAMES = 5
"""Frames of the film that are reconstructed, from the first on."""
PLUME = {
    "as the config has it": (),
    "30 iterations": ("--iterations", "30"),
    "diffusion alone": ("-D", "diffusion.transport_rounds=0"),
    "two rounds": ("-D", "diffusion.transport_rounds=2"),
    "loss: display": ("-D", "optimize.loss=display"),
    "loss: photon": ("-D", "optimize.loss=photon"),
    "engine torch": ("--engine", "torch"),
}


def read_density(path: Path) -> np.ndarray:
    return read_field(path, "density").values.astype(np.float64)


def print_plume(folder: Path) -> None:
    """A row for each of the settings of `PLUME`, after a run that compiles kernels."""
    columns = "held out", "L1", "L2", "seconds"
    measure(CONFIGS["plume"], folder / "first", ("--iterations", "6"))
    print_header("run", *columns)
    for name, options in PLUME.items():
        place = folder / name.replace(" ", "_").replace(":", "")
        print_measured(name, measure(CONFIGS["plume"], place, options), columns)


def rotation_between(found: np.ndarray, true: np.ndarray) -> float:
    """The angle [degrees] by which the poses [3, 4] `found` and `true` are turned."""
    chord = np.linalg.norm(found[:, :3] - true[:, :3]) / 8**0.5
    return float(np.degrees(2 * np.arcsin(min(chord, 1))))


def pixels_off(found: np.ndarray, true: np.ndarray, focal: float, smoke: Path) -> float:
    """How far the camera `found` sees the `smoke` from where `true` does [pixels], on average."""
    density = read_density(smoke)
    low, high = np.load(smoke)["bounds"]
    cells = np.argwhere(density > 0)
    points = low + (cells[:, ::-1] + 0.5) / density.shape[::-1] * (high - low)
    rays = []
    for pose in (found, true):
        places = (points - pose[:, 3]) @ pose[:, :3]
        rays.append(places / np.linalg.norm(places, axis=1, keepdims=True))
    angles = np.linalg.norm(np.cross(*rays), axis=1)
    return float(focal * np.average(angles, weights=density[density > 0]))


def cameras_off(poses: list[Any], frames: list[Any], smoke: Path) -> np.ndarray:
    """By how far each of the `poses` is turned [degrees], and off in the picture [pixels]."""
    errors = []
    for pose, frame in zip(poses, frames, strict=True):
        both = [np.array(matrix)[:3] for matrix in (pose, frame["transform_matrix"])]
        errors.append((rotation_between(*both), pixels_off(*both, frame["fl_x"], smoke)))
    return np.array(errors)


def print_capture(folder: Path) -> None:
    """Runs the capture, and prints what it found beside what its cameras were told."""
    row = measure(CONFIGS["capture"], folder)
    values = json.loads((folder / "parameters.json").read_text())
    files = (CAPTURE / name for name in ("transforms.json", "truth.json"))
    told, truth = (json.loads(file.read_text())["frames"][:-1] for file in files)
    names = [f"views.{Path(frame['file_path']).stem}" for frame in truth]
    exposures = [frame["exposure"] for frame in truth]
    gains = np.divide([values[f"{name}.exposure"] for name in names], exposures)
    lamp = np.divide(values["lights.0.irradiance"], LAMP)
    poses = (
        [frame["transform_matrix"] for frame in told],
        [values[f"{name}.camera"]["matrix"] for name in names],
    )
    given, found = (cameras_off(pose, truth, CAPTURE / "density.npz").T for pose in poses)
    print_header("what", "given", "found")
    print_row("held-out picture, as displayed", "", f"{row['held out'][0]:.1f} dB")
    print_row("density, relative L1 error", "", *row["L1"])
    print_row("exposures, mean error", "", f"{100 * np.abs(gains - 1).mean():.1f} %")
    print_row("exposures, worst error", "", f"{100 * np.abs(gains - 1).max():.1f} %")
    print_row("lamp, error by color", "", ", ".join(f"{part:+.0f} %" for part in 100 * (lamp - 1)))
    for what, *pair in zip(("turn [degrees]", SHIFT), given, found, strict=True):
        print_row(what, *(f"{errors.min():.2f} to {errors.max():.2f}" for errors in pair))
    print_row("seconds of the process", "", f"{row['seconds'][0]:.0f}")


def run_film(folder: Path, *options: str) -> tuple[dict[str, Any], Used]:
    """What `film.json` says of the film in `folder`, and what its run took."""
    used = ddrecon("optimize", ROOT / "configs/film.yaml", "-o", folder, *options)
    return json.loads((folder / "film.json").read_text()), used


def calibration_errors(values: dict[str, Any], number: int) -> tuple[float, float, float]:
    """Mean errors of cameras by the smoke of the frame `number`, and the lamp's [degrees]."""
    truth = json.loads((FILM / "truth.json").read_text())
    frames = [frame for frame in truth["frames"] if frame["file_path"] in truth["train_filenames"]]
    names = (frame["file_path"].partition("_{")[0] for frame in frames)
    poses = [values[f"views.{name}.camera"]["matrix"] for name in names]
    turn, shift = cameras_off(poses, frames, FILM / f"density_{number:04d}.npz").mean(0)
    sun, true = (np.divide(one, np.linalg.norm(one)) for one in (values["lights.0.direction"], SUN))
    return turn, shift, float(np.degrees(np.arccos(sun @ true)))


def flicker(folder: Path, numbers: Sequence[int]) -> float:
    """The second difference in time of the error of the film in `folder` over that of the truth."""
    found = [read_density(folder / f"frames/{n:04d}/volumes/density.npz") for n in numbers]
    true = [coarsened(read_density(FILM / f"density_{n:04d}.npz"), found[0].shape) for n in numbers]
    bends = [np.diff(each, 2, axis=0) for each in (np.subtract(found, true), true)]
    return float(np.divide(*map(np.linalg.norm, bends)))


def print_film(folder: Path) -> None:
    """Reconstructs the first frames of the film, and the last of them alone from nothing."""
    last, number = f"0:{FRAMES - 1}", FRAMES - 1
    film, used = run_film(folder / "film", "--frames", last)
    only = {"first": number, "last": number, "calibrate": 0}
    keys = as_options([f"frames.{key}={value}" for key, value in only.items()])
    alone, used_alone = run_film(folder / "alone", *keys)
    one, other = film["frames"][-1], alone["frames"][-1]
    print_header("what", "five frames of the film", "the last of them alone")
    for what, key in (("held out", "test_psnr"), ("the same, registered", "registered_psnr")):
        print_row(f"{what}, last frame [dB]", f"{one[key]:.1f}", f"{other[key]:.1f}")
    in_film = [row["seconds"] for row in film["frames"][1:]]
    seconds = np.mean(in_film), other["seconds"]
    print_row("seconds of a frame, later ones", *(f"{taken:.1f}" for taken in seconds))
    both = used, used_alone
    print_row("seconds of the process", *(f"{taken.seconds:.0f}" for taken in both))
    print_row("most memory of the process [MiB]", *(f"{taken.memory:.0f}" for taken in both))
    values = json.loads((folder / f"alone/frames/{number:04d}/parameters.json").read_text())
    errors = calibration_errors(film["values"], number), calibration_errors(values, number)
    names = "turn of cameras [degrees]", SHIFT, "turn of the lamp [degrees]"
    for what, *pair in zip(names, *errors, strict=True):
        print_row(what, *(f"{error:.2f}" for error in pair))
    print_row("flicker of cells", f"{flicker(folder / 'film', range(FRAMES)):.2f}", "")


def main() -> None:
    """Runs what the command line asks for."""
    prints = {"plume": print_plume, "capture": print_capture, "film": print_film}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=prints)
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    folder = given.output or Path(tempfile.mkdtemp())
    prints[given.what](folder.resolve() / given.what)


if __name__ == "__main__":
    main()
