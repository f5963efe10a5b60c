"""Iterations a second and peak memory of reconstructions, meant for a GPU: the paper's size, its
joint case, and as many cells as fit.

    python benchmarks/gpu.py [--device cuda] [--shrink 1]

Each reconstructs a plume of `ddrecon.bench.plume` from its own image at full resolution, one view.
`--shrink 8` makes grids and images eight times smaller, to try the script where there is no GPU.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import torch
from scaling import start_run

from ddrecon.bench.plume import plume_scene
from ddrecon.reconstruct.loop import Reconstruction

SMALL = "64 x 96 x 64, 512 x 512, density (the paper: 22.5 iterations a second on an RTX 2080 Ti)"
JOINT = (
    "168 x 252 x 168, 512 x 512, density, sigma_a and sigma_s in RGB: 49.8 million numbers "
    "(the paper: 8 s an iteration)"
)
LARGE = "448 x 672 x 448, 512 x 512, density"
CASES = {
    SMALL: (64, 512, False, 30),
    JOINT: (168, 512, True, 5),
    LARGE: (448, 512, False, 2),
}
"""Cells across, pixels across, whether colored fields are optimized too, and iterations."""


def run_of(cells: int, pixels: int, is_joint: bool, device: torch.device) -> Reconstruction:
    """A reconstruction of a plume from its image, from half its density."""
    scene = plume_scene(cells, pixels, torch.float32, device)
    if not is_joint:
        return start_run(scene)
    volume, shape = scene.volume, (3, *scene.volume.grid.shape)
    colors = torch.tensor([1.0, 0.9, 0.7], device=device).view(3, 1, 1, 1)
    fields = {
        name: (getattr(volume, name) * colors).expand(shape).contiguous()
        for name in ("sigma_a", "sigma_s")
    }
    joint = replace(scene, volume=replace(volume, **fields))
    return start_run(joint, ("density", *fields))


def measure(name: str, run: Reconstruction, iterations: int, device: torch.device) -> str:
    """One line of the table."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    run.step()
    start = now(device)
    for _ in range(iterations):
        run.step()
    seconds = (now(device) - start) / iterations
    peak = (
        f"{torch.cuda.max_memory_allocated(device) / 2**30:.2f} GiB"
        if device.type == "cuda"
        else "-"
    )
    return f"| {name} | {seconds:.4f} | {1 / seconds:.1f} | {peak} |"


def now(device: torch.device) -> float:
    """The time, once the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--shrink", type=int, default=1)
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    print(
        f"{torch.cuda.get_device_name(device) if device.type == 'cuda' else 'CPU'}, torch "
        f"{torch.__version__}"
    )
    print("| case | seconds an iteration | iterations a second | peak memory |\n|---|---|---|---|")
    for name, (cells, pixels, is_joint, iterations) in CASES.items():
        shrunk = cells // arguments.shrink, pixels // arguments.shrink
        print(measure(name, run_of(*shrunk, is_joint, device), iterations, device), flush=True)


if __name__ == "__main__":
    main()
