"""Against pyshdom, on its own pictures: nine views of a cloud of a large-eddy simulation by SHDOM.

    python benchmarks/pyshdom.py FOLDER [-o FOLDER] [-D KEY=VALUE]...

FOLDER is a copy of github.com/vholod/pyshdom, whose license is not commercial: nothing of it is
kept here. Its pickle is read without running its classes. Errors of images are relative RMS; L1 and
mass are of extinction, relative, as pyshdom scores itself. `-D` overrides keys of the scene.
"""

from __future__ import annotations

import argparse
import json
import math
import pickle
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from figures import as_options, ddrecon, print_header, print_row

CLOUD = "synthetic_cloud_fields/jpl_les/rico32x37x26.txt"
PICTURES = "vadim/experiments/LES_cloud_field_rico/monochromatic/measurements"
SUN = (math.sin(math.radians(165)), 0.0, math.cos(math.radians(165)))
WAVELENGTH = 0.672
"""In micrometers, as droplets' radii are."""
EFFICIENCY = 2.07
"""The extinction of such droplets over their shadow (Mie's theory)."""
EXTINCTION = 60.0
"""Of density 1 [1/km]."""
AIR = 0.0065
"""Optical depth of the air in the pictures. What it scatters once is an offset of each view."""
XYZ = ("_x", "_y", "_z")
BARE = 0.05
"""Pixels that differ by less than this part from the bare ground show nothing."""
MASKED = "with_the_true_mask"
RUNS = {MASKED: ["volume.sigma_t={file: mask.npz}"], "from_pictures_alone": []}
"""Overrides of each reconstruction."""
SCORES = {"relative L1 error": ".3f", "mass": "+.1%", "seconds": ".0f"}
THEIRS = ("0.381", "-7.5%", "1116")
"""Their own score, as they kept it: after 19 iterations."""


class Record:
    """What an object of theirs had for its `state`; nothing of its class."""

    def __init__(self, *_: object):
        self.state: dict[str, Any] = {}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.state = state


class Arrays(pickle.Unpickler):
    """Reads arrays and plain containers. All else becomes a `Record`: nothing is run."""

    def find_class(self, module: str, name: str) -> Any:
        if module.split(".")[0] == "numpy":
            known = {"ndarray": np.ndarray, "dtype": np.dtype}
            makers = {key: getattr(np._core.multiarray, key) for key in ("_reconstruct", "scalar")}
            return (known | makers).get(name, Record)
        if (module, name) == ("dill._dill", "_get_attr"):
            return lambda _, attribute: self.find_class("numpy", attribute)
        return Record


def read_cloud(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Extinction [z, y, x] [1/km], corners of cells around its points, and the mean radius."""
    _, counts, heights, *rows = (line.split() for line in path.read_text().splitlines())
    size = np.array(counts, dtype=int)
    dx, dy, low, *_, high = map(float, heights)
    step, start = np.array([dx, dy, (high - low) / (size[2] - 1)]), np.array([0, 0, low])
    table = np.array(rows, dtype=float)
    water, radius = table[:, 3:5].T  # g/m^3, micrometers
    extinction = np.zeros(size[::-1])
    x, y, z = table[:, :3].astype(int).T
    extinction[z, y, x] = 750 * EFFICIENCY * water / radius
    bounds = np.stack([start - step / 2, start + (size - 0.5) * step])
    return extinction, bounds, float(np.average(radius, weights=extinction[z, y, x]))


def view_of(projection: dict[str, Any], name: str) -> dict[str, Any]:
    """The view of parallel rays along y and z, through points of a level plane."""
    mu, phi = (float(projection[key][0]) for key in ("_mu", "_phi"))
    y = math.sqrt(max(1 - mu**2, 0)) * math.sin(phi)
    target = [(float(projection[key].min()) + float(projection[key].max())) / 2 for key in XYZ]
    across, along = (float(projection[f"_{axis}_resolution"]) for axis in "xy")
    cosine = SUN[1] * y + SUN[2] * mu
    return {
        "name": name,
        "image": f"{name}.npy",
        "mask": f"shown_{name}.npy",
        "offset": AIR / mu / -SUN[2] * 3 / (16 * math.pi) * (1 + cosine**2),
        "camera": {
            "type": "orthographic",
            "origin": [target[0], target[1] + 5 * y, target[2] + 5 * mu],
            "target": target,
            "up": [0, mu, -y],
            "width": across * int(projection["_resolution"][0]),
            "pixel_aspect": mu * along / across,
        },
    }


def write_scene(copy: Path, folder: Path) -> None:
    """The scene of the pictures in the `copy` of pyshdom, with what it needs, in `folder`."""
    extinction, bounds, radius = read_cloud(copy / CLOUD)
    fields = {"cloud": ("density", extinction / EXTINCTION)}
    fields["mask"] = ("sigma_t", EXTINCTION * (extinction > 0))
    for file, (name, field) in fields.items():
        np.savez(folder / f"{file}.npz", bounds=bounds, **{name: field.astype(np.float32)})
    with (copy / PICTURES).open("rb") as file:
        seen = Arrays(file).load()
    projections = seen["_camera"].state["_projection"].state["_projection_list"]
    views = [view_of(one.state, f"view_{number}") for number, one in enumerate(projections)]
    for view, image in zip(views, seen["_images"], strict=True):
        picture = np.repeat(image.T[::-1, :, None], 3, axis=2)
        # Along the sides of their domain there is no shadow: these show the bare ground.
        bare = np.median(picture[:, [0, -1]])
        np.save(folder / view["image"], picture)
        np.save(folder / view["mask"], (abs(picture - bare) > BARE * bare).astype(np.float32))
    droplets = {"type": "mie", "wavelength": WAVELENGTH, "refractive_index": 1.331}
    droplets |= {"effective_radius": radius, "effective_variance": 0.1}
    medium = {"sigma_t": EXTINCTION, "albedo": 1, "phase": droplets}
    scene = {
        "volume": {"up": "z", "density": {"file": "cloud.npz"}, **medium},
        "ground": {"height": 0, "albedo": 0.05},
        # 1 on level ground
        "lights": [{"type": "directional", "direction": SUN, "irradiance": -1 / SUN[2]}],
        "views": views,
    }
    density = {"init": 0, "support": "masks", "support_margin": 0}
    sought = {"parameters": {"density": density}}
    (folder / "true.yaml").write_text(json.dumps(scene))  # JSON is YAML
    (folder / "sought.yaml").write_text(json.dumps(scene | {"optimize": sought}))


def image_errors(folder: Path, overrides: list[str]) -> list[float]:
    """How far each of our pictures of the true cloud is from theirs."""
    ddrecon("render", "true.yaml", "-o", "images", *overrides, folder=folder)
    errors = []
    for path in sorted(folder.glob("view_?.npy")):
        theirs, ours = np.load(path), np.load(folder / "images" / path.name)
        errors.append(float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs)))
    return errors


def reconstruct(folder: Path, name: str, overrides: list[str]) -> tuple[float, float, float]:
    """L1 and mass of the extinction found, against the true one, and seconds of the process."""
    seconds = ddrecon("optimize", "sought.yaml", "-o", name, *overrides, folder=folder).seconds
    true = np.load(folder / "cloud.npz")["density"]
    found = np.load(folder / name / "volumes" / "density.npz")["density"]
    if name == MASKED:
        found = found * (true > 0)
    return np.abs(found - true).sum() / true.sum(), found.sum() / true.sum() - 1, seconds


def main() -> None:
    """Writes the scene, renders it and reconstructs it: a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("copy", type=Path)
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("-D", dest="keys", action="append", default=[])
    given = parser.parse_args()
    folder = given.output or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    write_scene(given.copy, folder)
    overrides = as_options(given.keys)
    print_header("what", "pyshdom", "ours")
    errors = image_errors(folder, overrides)
    print_row("pictures of the true cloud: mean error", "", f"{np.mean(errors):.3f}")
    print_row("the same, worst of nine", "", f"{max(errors):.3f}")
    for name, keys in RUNS.items():
        found = reconstruct(folder, name, [*as_options(keys), *overrides])
        theirs = THEIRS if name == MASKED else ("", "", "")
        for what, score, ours in zip(SCORES, theirs, found, strict=True):
            print_row(f"{name.replace('_', ' ')}: {what}", score, format(ours, SCORES[what]))


if __name__ == "__main__":
    main()
