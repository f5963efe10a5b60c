"""Peak memory against what `ddrecon check` predicts.

    python benchmarks/memory.py [--cells 64 96]

Every figure is the highest resident size of a process of its own, less that of the same work on
16^3 cells.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path

import numpy as np
from figures import ddrecon, print_header, print_row

SMALL = 16
RGB = {"albedo": [0.95, 0.9, 0.8]}
BOTH = {"sigma_a": [1.0, 2.0, 4.0], "sigma_s": [19.0, 18.0, 16.0]}
ONE_ROUND = {"transport_rounds": 1, "degree": 3}
CASES: dict[str, tuple[dict[str, object], dict[str, object], tuple[str, ...]]] = {
    "gray": ({}, {}, ()),
    "RGB": (RGB, {}, ()),
    "RGB, g 0.3": (RGB | {"g": 0.3}, {}, ()),
    "RGB, g 0.3, one round": (RGB | {"g": 0.3}, ONE_ROUND, ()),
    "RGB, flux-limited": (RGB, {"model": "flux_limited"}, ()),
    "RGB fields": (RGB, {}, ("albedo",)),
    "density, sigma_a and sigma_s": (BOTH, {}, ("sigma_a", "sigma_s")),
    "density, sigma_a and sigma_s, g 0.3": (BOTH | {"g": 0.3}, {}, ("sigma_a", "sigma_s")),
}
"""What is said of the medium and of diffusion, and the fields that are sought beside density."""


def write_scene(folder: Path, cells: int, pixels: int, title: str, is_optimized: bool) -> Path:
    """The file of a scene of one view of the case `title`, in `folder`."""
    medium, diffusion, fields = CASES[title]
    optics = {} if "sigma_a" in medium else {"sigma_t": 20, "albedo": 0.9}
    box = {"bounds": {"min": [-0.5] * 3, "max": [0.5] * 3}, "resolution": [cells] * 3}
    camera = {"type": "perspective", "origin": [0, 0.3, 3.2], "target": [0, 0, 0]}
    view = {"name": "view", "camera": camera | {"fov": 28, "resolution": [pixels] * 2}}
    plain = {"transport_rounds": 0, "model": "p1", "tolerance": 1e-2}
    scene: dict[str, object] = {
        "volume": {**box, "density": 1, "g": 0.0, **optics, **medium},
        "lights": [{"type": "directional", "direction": [-2, -2, -1], "irradiance": 3.14159}],
        "views": [view],
        "diffusion": plain | diffusion,
    }
    if is_optimized:
        np.save(folder / "view.npy", np.full((pixels, pixels, 3), 0.1, np.float32))
        scene["views"] = [view | {"image": "view.npy", "split": "train"}]
        starts = {name: 0.9 if name == "albedo" else medium[name] for name in fields}
        parameters = {name: {"init": start, "field": True} for name, start in starts.items()}
        scene["optimize"] = {"iterations": 20, "parameters": {"density": {"init": 1}, **parameters}}
    path = folder / "scene.yaml"
    path.write_text(json.dumps(scene))
    return path


def measure(folder: Path, verb: str, cells: int, pixels: int, title: str) -> tuple[float, int]:
    """The peak of `verb` and what `ddrecon check` says of the scene [bytes]."""
    path = write_scene(folder, cells, pixels, title, verb == "optimize")
    check = [sys.executable, "-m", "ddrecon", "check", path, "--json"]
    report = subprocess.run(check, capture_output=True, text=True, check=True).stdout
    used = ddrecon(verb, path, "-o", folder / verb)
    return used.memory * 2**20, int(json.loads(report)["memory_bytes"])


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cells", type=int, nargs="*", default=[64, 96])
    options = parser.parse_args()
    print_header("scene", "cells", "command", "peak [MiB]", "predicted / peak")
    with tempfile.TemporaryDirectory() as name:
        for title, verb in product(CASES, ("render", "optimize")):
            base = measure(Path(name), verb, SMALL, 16, title)[0]
            for cells in options.cells:
                taken, predicted = measure(Path(name), verb, cells, 256, title)
                used = taken - base
                figures = f"{used / 2**20:.0f}", f"{predicted / used:.2f}"
                print_row(title, f"{cells}^3", verb, *figures)


if __name__ == "__main__":
    main()
