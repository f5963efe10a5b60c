"""Fluence in the digital mouse beside photons of uMCX: a body of 21 tissues, lit from above.

    python benchmarks/mouse.py FOLDER

FOLDER has `digimouse.json` of github.com/fangq/mcx, and `umcx`, built from github.com/fangq/umcx
with one thread. The index of refraction is 1 everywhere: ours has one for the whole box.
"""

from __future__ import annotations

import argparse
import base64
import json
import subprocess
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from figures import ddrecon, print_header, print_row

PHOTONS = 3_000_000
LAYERS = ((0, 2), (2, 4), (4, 8), (8, 12), (12, 20))
"""Depths below the skin [mm]."""


def read_mouse(path: Path, every: int) -> tuple[np.ndarray, float, list[dict[str, float]]]:
    """Labels [x, y, z] of every so many voxels, their width [mm], and what each label scatters."""
    mouse = json.loads(path.read_text(), strict=False)
    shapes, domain = mouse["Shapes"], mouse["Domain"]
    text = zlib.decompress(base64.b64decode(shapes["_ArrayZipData_"]))
    labels = np.frombuffer(text, shapes["_ArrayType_"]).reshape(shapes["_ArraySize_"])
    coarse = labels[tuple(slice(0, n // every * every, every) for n in labels.shape)]
    return coarse, every * domain["LengthUnit"], domain["Media"]


def trace_photons(
    folder: Path, program: Path, labels: np.ndarray, width: float, media: list[dict]
) -> tuple[np.ndarray, float]:
    """Fluence [x, y, z] by photons, as large as that of an irradiance of 1, and seconds."""
    # Photons end where they enter label 0 from a tissue: the air gets a label of its own.
    filled = np.where(labels, labels, len(media)).astype(np.uint8)
    clear = {"mua": 0.0, "mus": 0.0, "g": 1.0}
    x, y, z = labels.shape
    shapes = {"_ArrayType_": "uint8", "_ArraySize_": [x, y, z], "_ArrayZipSize_": filled.size}
    packed = base64.b64encode(zlib.compress(filled.tobytes())).decode()
    shapes |= {"_ArrayZipType_": "zlib", "_ArrayZipData_": packed}
    source = {"Type": "planar", "Pos": [0, 0, z - 1e-3], "Dir": [0, 0, -1, 0]}
    source |= {"Param1": [x, 0, 0, 0], "Param2": [0, y, 0, 0]}
    rows = [row | {"n": 1.0} for row in [clear, *media[1:], clear]]
    off = {"DoMismatch": False, "DoPartialPath": False}
    job = {
        "Session": {"ID": "mouse", "Photons": PHOTONS, "OutputType": "x"} | off,
        "Forward": {"T0": 0, "T1": 5e-6, "Dt": 5e-6},
        "Domain": {"LengthUnit": width, "Dim": [x, y, z], "OriginType": 1, "Media": rows},
        "Optode": {"Source": source, "Detector": []},
        "Shapes": shapes,
    }
    (folder / "mouse.json").write_text(json.dumps(job))
    start = time.perf_counter()
    run = subprocess.run([program, "mouse.json"], cwd=folder, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    values = np.frombuffer((folder / "mouse.bnii").read_bytes()[-4 * labels.size :], "<f4")
    values = values.reshape(labels.shape)
    # Its scale depends on the voxels' width; the absorbed part that it prints does not.
    absorbed = float(run.stdout.split("absorbed")[1].split("%")[0]) / 100
    return values * absorbed / absorbed_part(values, labels, width, media), seconds


def absorbed_part(
    fluence: np.ndarray, labels: np.ndarray, width: float, media: list[dict[str, Any]]
) -> float:
    """The part of light of irradiance 1 on the box's top that tissues absorb."""
    absorption = np.array([row["mua"] for row in media])[labels]
    return float((fluence * absorption).sum()) * width / (labels.shape[0] * labels.shape[1])


def render_fluence(
    folder: Path, labels: np.ndarray, width: float, media: list[dict[str, Any]]
) -> tuple[np.ndarray, float]:
    """Fluence [x, y, z] by ddrecon at its defaults, and seconds of the process."""
    size = width * np.array(labels.shape)
    bounds = np.stack([np.zeros(3), size])
    np.savez(folder / "mouse.npz", labels=labels.transpose(2, 1, 0), bounds=bounds)
    tables = {
        key: {"labels": "mouse.npz", "table": [row[name] if row["mus"] else 0 for row in media]}
        for key, name in (("sigma_a", "mua"), ("sigma_s", "mus"), ("g", "g"))
    }
    camera = {"type": "orthographic", "width": float(size[0]), "resolution": [16, 16]}
    camera |= {"origin": [0, 0, 100], "target": [0, 0, 0], "up": [0, 1, 0]}
    scene = {
        "volume": {"density": 1, **tables},
        "lights": [{"type": "directional", "direction": [0, 0, -1], "irradiance": 1}],
        "views": [{"name": "top", "camera": camera}],
    }
    (folder / "mouse.yaml").write_text(json.dumps(scene))  # JSON is YAML
    seconds = ddrecon("render", "mouse.yaml", "-o", "out", "--fluence", folder=folder).seconds
    fluence = np.load(folder / "out" / "volumes" / "fluence.npz")["fluence"]
    return fluence.transpose(2, 1, 0), seconds


def main() -> None:
    """Prints a row for every coarseness of voxels."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder.resolve()
    depths = [f"{low} to {high} mm" for low, high in LAYERS]
    print_header("voxels", "absorbed, uMCX", "absorbed, ours", *depths, "uMCX s", "ours s")
    for every in (4, 2):
        labels, width, media = read_mouse(folder / "digimouse.json", every)
        with tempfile.TemporaryDirectory() as place:
            body = labels, width, media
            theirs, their_seconds = trace_photons(Path(place), folder / "umcx", *body)
            ours, seconds = render_fluence(Path(place), *body)
        depth = width * np.cumsum((labels > 0)[..., ::-1], axis=2)[..., ::-1]
        layers = [(labels > 0) & (depth > low) & (depth <= high) for low, high in LAYERS]
        ratios = [ours[layer].mean() / theirs[layer].mean() - 1 for layer in layers]
        shares = [f"{absorbed_part(f, labels, width, media):.4f}" for f in (theirs, ours)]
        times = f"{their_seconds:.0f}", f"{seconds:.0f}"
        print_row(f"{width:.1f} mm", *shares, *(f"{ratio:+.1%}" for ratio in ratios), *times)


if __name__ == "__main__":
    main()
