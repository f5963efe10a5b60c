"""What leaving samples out saves, or would save: empty slices of a fixed medium, and what lies
behind an opaque one.

python benchmarks/skipping.py
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import torch
from torch import Tensor

from ddrecon.diffusion.implicit import SolveMemory
from ddrecon.io.volumes.table import read_field
from ddrecon.renderer import solve_light, view_image
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene

ROOT = Path(__file__).parents[1]
PLUME = f"volume.density={{file: {ROOT / 'data/plume/density.npz'}}}"
SCENES: dict[str, tuple[str, list[str]]] = {
    "an empty box (`configs/plume.yaml`)": ("plume", []),
    "the plume": ("plume", [PLUME]),
    "the ball (`data/ball/truth.yaml`)": ("../data/ball/truth", []),
}
OPAQUE = {
    "plume": (("plume/density", 10.0), ("plume/density", 30.0)),
    "cloud": (("shapes/cloud", 40.0),),
    "bunny": (("shapes/bunny", 80.0),),
}
"""Volumes under data/, and sigma_t [1/u]."""
DARK, TILE, REPEATS = 1e-4, 8, 5


def seconds(scene: Scene, is_varied: bool) -> float:
    """The least processor time of the first view; a medium that is varied is marched whole."""
    scene.volume.density = scene.volume.density.detach().requires_grad_(is_varied)
    light, least = solve_light(scene, SolveMemory()), math.inf
    for _ in range(REPEATS):
        start = time.process_time()
        view_image(light, scene, scene.views[0].camera)
        least = min(least, time.process_time() - start)
    return least


def dark_parts(density: Tensor, sigma_t: float) -> tuple[float, float]:
    """The part of all samples along z that less than `DARK` of the light reaches: ray by ray, and
    where whole tiles of rays could stop.
    """
    step = 1 / density.shape[0]
    is_dark = (density * sigma_t * step).cumsum(0) > -math.log(DARK)
    tiles = is_dark.unfold(1, TILE, TILE).unfold(2, TILE, TILE).flatten(3).all(-1)
    return float(is_dark.float().mean()), float(tiles.float().mean())


def main() -> None:
    """Prints two tables."""
    torch.set_num_threads(1)
    print(
        "| scene | time of a view with empty slices left out, as a part of that without "
        "|\n|---|---|"
    )
    with torch.no_grad():
        for name, (config, overrides) in SCENES.items():
            scene = load_scene(ROOT / "configs" / f"{config}.yaml", overrides=overrides)
            print(f"| {name} | {seconds(scene, False) / seconds(scene, True):.2f} |")
    print(
        f"\n| volume | sigma_t | samples behind {DARK:g}, by rays | by tiles of {TILE} x {TILE} "
        "|\n|---|---|---|---|"
    )
    for name, cases in OPAQUE.items():
        for file, sigma_t in cases:
            density = torch.from_numpy(read_field(ROOT / "data" / f"{file}.npz", "density").values)
            rays, tiles = dark_parts(density, sigma_t)
            print(f"| {name} | {sigma_t:g} | {rays:.3f} | {tiles:.3f} |")


if __name__ == "__main__":
    main()
