"""Peak memory against what `ddrecon check` predicts.

    python benchmarks/memory.py [--count]

Every figure is the highest resident size of a process of its own, less that of the same work on
16^3 cells. With `--count` it is the most numbers a cell that tensors hold at once, and which
allocation found that many: exact, in one process, and the same on every machine.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from figures import ddrecon, print_header, print_row
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

SMALL = 16
RGB = {"albedo": [0.95, 0.9, 0.8]}
BOTH = {"sigma_a": [1.0, 2.0, 4.0], "sigma_s": [19.0, 18.0, 16.0]}
ONE_ROUND = {"transport_rounds": 1, "degree": 3}
CASES: dict[str, tuple[dict[str, object], dict[str, object], tuple[str, ...]]] = {
    "gray": ({}, {}, ()),
    "RGB": (RGB, {}, ()),
    "RGB, g 0.3": (RGB | {"g": 0.3}, {}, ()),
    "RGB, g 0.3, one round": (RGB | {"g": 0.3}, ONE_ROUND, ()),
    "RGB, g 0.3, degree 5": (RGB | {"g": 0.3}, ONE_ROUND | {"degree": 5}, ()),
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


class Alive(TorchDispatchMode):
    """Counts the bytes of all tensors that are alive, at their `peak`, and `where` that was."""

    LEAST = 4096

    def __init__(self) -> None:
        super().__init__()
        self.known: dict[int, tuple[StorageWeakRef, int]] = {}
        self.peak, self.where = 0, ""

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        made, is_new = function(*arguments, **(options or {})), False
        for tensor in (leaf for leaf in tree_leaves(made) if isinstance(leaf, torch.Tensor)):
            storage = tensor.untyped_storage()
            known = self.known.get(storage._cdata)
            if storage.nbytes() >= self.LEAST and (known is None or known[0].expired()):
                self.known[storage._cdata] = StorageWeakRef(storage), storage.nbytes()
                is_new = True
        if is_new:
            self.known = {key: one for key, one in self.known.items() if not one[0].expired()}
            if (total := sum(size for _, size in self.known.values())) > self.peak:
                self.peak, self.where = total, place()
        return made


def place() -> str:
    """The innermost place in ddrecon that is being run."""
    frame = sys._getframe()
    while frame is not None and "/ddrecon/" not in frame.f_code.co_filename:
        frame = frame.f_back
    if frame is None:
        return ""
    return f"{frame.f_code.co_filename.partition('/ddrecon/')[2]}, `{frame.f_code.co_name}`"


def count(folder: Path, cells: int, title: str) -> tuple[float, float, str]:
    """Numbers a cell at the peaks of a render and of an iteration, and where the latter is."""
    from ddrecon.diffusion.implicit import SolveMemory
    from ddrecon.picture import render_each
    from ddrecon.reconstruct.loop import Reconstruction
    from ddrecon.scene_file.build import load_scene

    scene = load_scene(write_scene(folder, cells, 16, title, is_optimized=True))
    with Alive() as render, torch.no_grad():
        scene.volume.density = scene.volume.density.clone()
        render_each(scene, scene.views, SolveMemory())
    with Alive() as iteration:
        search = Reconstruction(scene)
        while not search.is_done:
            search.step()
    numbers = [mode.peak / 4 / cells**3 for mode in (render, iteration)]
    return *numbers, iteration.where


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
    parser.add_argument("--count", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.count:
            print_header("scene", "render", "iteration", "at its peak")
            count(folder, 48, "gray")  # what is made once for a grid does not count
            for title in CASES:
                render, iteration, where = count(folder, 48, title)
                print_row(title, f"{render:.0f}", f"{iteration:.0f}", where)
            return
        print_header("scene", "cells", "command", "peak [MiB]", "predicted / peak")
        for title in CASES:
            for verb in ("render", "optimize"):
                base = measure(folder, verb, SMALL, 16, title)[0]
                for cells in options.cells:
                    taken, predicted = measure(folder, verb, cells, 256, title)
                    used = taken - base
                    figures = f"{used / 2**20:.0f}", f"{predicted / used:.2f}"
                    print_row(title, f"{cells}^3", verb, *figures)


if __name__ == "__main__":
    main()
