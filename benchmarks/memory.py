"""Peak memory against what `ddrecon check` predicts, and bytes per cell and color of a forward and
adjoint solve.

    python benchmarks/memory.py [--count]

Every figure is the highest resident size of a process of its own, less that of the same work on
16^3 cells. With `--count` it is the most numbers a cell that tensors hold at once, and which
allocation found that many: exact, in one process, and the same on every machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

SMALL = 16
SCENE = {
    "volume": {
        "bounds": {"min": [-0.5] * 3, "max": [0.5] * 3},
        "density": 1,
        "sigma_t": 20,
        "g": 0.0,
    },
    "lights": [{"type": "directional", "direction": [-2, -2, -1], "irradiance": 3.14159}],
}
CAMERA = {"type": "perspective", "target": [0, 0, 0], "up": [0, 1, 0], "fov": 28}
CASES = {
    "gray": {},
    "RGB": {"albedo": [0.95, 0.9, 0.8]},
    "RGB, g 0.3": {"albedo": [0.95, 0.9, 0.8], "g": 0.3},
    "RGB, g 0.3, one round": {"albedo": [0.95, 0.9, 0.8], "g": 0.3, "rounds": 1, "degree": 3},
    "RGB, g 0.3, degree 5": {"albedo": [0.95, 0.9, 0.8], "g": 0.3, "rounds": 1, "degree": 5},
    "RGB, flux-limited": {"albedo": [0.95, 0.9, 0.8], "model": "flux_limited"},
    "RGB fields": {"albedo": [0.95, 0.9, 0.8], "fields": True},
    "density, sigma_a and sigma_s": {"albedo": [0.95, 0.9, 0.8], "joint": True},
    "density, sigma_a and sigma_s, g 0.3": {"albedo": [0.95, 0.9, 0.8], "g": 0.3, "joint": True},
}
SOLVE = """
import sys, torch
from pathlib import Path
from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.lighting import solve_light
from ddrecon.scene_file.build import load_scene
scene = load_scene(Path(sys.argv[1]))
density = scene.volume.density.requires_grad_()
torch.autograd.grad(solve_light(scene, SolveMemory()).diffuse[0].sum(), density)
"""


def scene_of(
    cells: int, pixels: int, case: dict[str, object], is_optimized: bool
) -> dict[str, object]:
    """A scene file's contents: one view."""
    volume = {
        **SCENE["volume"],
        "resolution": [cells] * 3,
        "albedo": case.get("albedo", 0.9),
        "g": case.get("g", 0.0),
    }
    views = [
        {"name": "view", "camera": {**CAMERA, "origin": [0, 0.3, 3.2], "resolution": [pixels] * 2}}
    ]
    scene = {**SCENE, "volume": volume, "views": views}
    scene["diffusion"] = {
        "transport_rounds": case.get("rounds", 0),
        "degree": case.get("degree"),
        "model": case.get("model", "p1"),
        "tolerance": 1e-2,
    }
    if is_optimized:
        scene["views"] = [{**views[0], "image": "view.npy", "split": "train"}]
        parameters: dict[str, object] = {"density": {"init": 1}}
        if case.get("fields"):
            parameters["albedo"] = {"init": 0.9, "field": True}
        if case.get("joint"):
            del volume["sigma_t"], volume["albedo"]
            volume |= {"sigma_a": [1.0, 2.0, 4.0], "sigma_s": [19.0, 18.0, 16.0]}
            parameters |= {
                name: {"init": volume[name], "field": True} for name in ("sigma_a", "sigma_s")
            }
        scene["optimize"] = {"iterations": 20, "parameters": parameters}
    return scene


def peak(command: list[str]) -> int:
    """The highest resident size [bytes] of `command`."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(process.stderr.read().decode())
    return usage.ru_maxrss * 1024


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


def count(folder: Path, cells: int, case: dict[str, object]) -> tuple[float, float, str]:
    """Numbers a cell at the peaks of a render and of an iteration, and where the latter is."""
    import numpy as np

    from ddrecon.diffusion.implicit import SolveMemory
    from ddrecon.picture import render_each
    from ddrecon.reconstruct.loop import Reconstruction
    from ddrecon.scene_file.build import load_scene

    np.save(folder / "view.npy", np.full((16, 16, 3), 0.1, np.float32))
    path = folder / "scene.yaml"
    path.write_text(json.dumps(scene_of(cells, 16, case, is_optimized=True)))
    scene = load_scene(path)
    with Alive() as render, torch.no_grad():
        scene.volume.density = scene.volume.density.clone()
        render_each(scene, scene.views, SolveMemory())
    with Alive() as iteration:
        run = Reconstruction(scene)
        while not run.is_done:
            run.step()
    numbers = [mode.peak / 4 / cells**3 for mode in (render, iteration)]
    return *numbers, iteration.where


def measure(
    folder: Path, verb: str, cells: int, pixels: int, case: dict[str, object]
) -> tuple[int, int]:
    """The peak of `verb` and what `ddrecon check` says of the scene [bytes]."""
    import numpy as np

    np.save(folder / "view.npy", np.full((pixels, pixels, 3), 0.1, np.float32))
    path = folder / "scene.yaml"
    path.write_text(json.dumps(scene_of(cells, pixels, case, verb == "optimize")))
    program = [sys.executable, "-c", "from ddrecon.cli import main; main()"]
    found = subprocess.run(
        [*program, "check", str(path), "--json"], capture_output=True, text=True, check=True
    )
    if verb == "solve":
        command = [sys.executable, "-c", SOLVE, str(path)]
    else:
        command = [*program, verb, str(path), "-o", str(folder / verb), "--overwrite", "-q"]
    return peak(command), int(json.loads(found.stdout)["memory_bytes"])


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cells", type=int, nargs="*", default=[64, 96])
    parser.add_argument("--pixels", type=int, default=256)
    parser.add_argument("--scene", choices=CASES, nargs="*", default=list(CASES))
    parser.add_argument("--count", action="store_true")
    arguments = parser.parse_args()
    if arguments.count:
        print("| scene | render | iteration | at its peak |\n|---|---|---|---|")
        with tempfile.TemporaryDirectory() as name:
            count(Path(name), 48, CASES["gray"])  # what is made once for a grid does not count
        for title in arguments.scene:
            with tempfile.TemporaryDirectory() as name:
                render, iteration, where = count(Path(name), 48, CASES[title])
            print(f"| {title} | {render:.0f} | {iteration:.0f} | {where} |", flush=True)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(
            "| scene | cells | solve, there and back [bytes per cell and color] | command | peak "
            "[MiB] | predicted / peak |"
        )
        print(f"|{'---|' * 6}")
        for title, case in ((title, CASES[title]) for title in arguments.scene):
            bases = {
                verb: measure(folder, verb, SMALL, 16, case)[0]
                for verb in ("solve", "render", "optimize")
            }
            for cells in arguments.cells:
                solve = measure(folder, "solve", cells, 16, case)[0] - bases["solve"]
                each = solve / (cells**3 - SMALL**3) / (3 if "albedo" in case else 1)
                for verb in ("render", "optimize"):
                    found, predicted = measure(folder, verb, cells, arguments.pixels, case)
                    used = found - bases[verb]
                    print(
                        f"| {title} | {cells}^3 | {each:.0f} | {verb} | {used / 2**20:.0f} | "
                        f"{predicted / used:.2f} |",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
