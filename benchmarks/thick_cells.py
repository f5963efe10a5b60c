"""How far images are from the truth where cells are optically thick: a table for docs/accuracy.md.

The truth is our own, on a grid six times as fine: the same density, linear between the centers of
the coarse grid, with angles to degree 5 and five rounds. Rays have so many samples a coarse cell.

    python benchmarks/thick_cells.py [-g -0.8]... [--depth 4]... [--samples 2]
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import torch
from accuracy import FAR, FRONT, SIDE, Case, Vector, around, sun, together
from torch import Tensor
from torch.nn.functional import interpolate

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Volume
from ddrecon.renderer import render
from ddrecon.scene import Scene
from ddrecon.settings import RenderSettings

CELLS, FINER, PIXELS = 12, 6, 16
BALLS = together(around((-0.13, -0.08, 0.05), 0.32, 0.2), around((0.17, 0.1, -0.05), 0.27, 0.2))
LIGHTS: dict[str, tuple[Vector, Vector]] = {
    "side": (SIDE, FRONT),
    "eye": ((2.0, -1.2, 2.2), FAR),
}
"""By where light comes from, the way it travels and the eye."""
ROUNDS = (0, 1, 2, 3, 6)


def coarse_scene(g: float, depth: float, lit: str, samples: int = 8, **diffusion: int) -> Scene:
    """Merged balls with `depth` optical depths a cell, lit from the `side` or from the `eye`."""
    travel, eye = LIGHTS[lit]
    width = math.tan(math.radians(11))
    case = Case(lit, BALLS, depth * CELLS, 0.95, g, [sun(travel)], eye, half_width=width)
    scene = case.scene(CELLS, tolerance=1e-5, **diffusion)
    views = [replace(view, camera=replace(view.camera, size=(PIXELS,) * 2)) for view in scene.views]
    return replace(scene, views=views, render=RenderSettings(4, samples, 0.0))


def refine(scene: Scene) -> Scene:
    """`scene` in finer cells."""
    volume = scene.volume
    density = interpolate(volume.density[None, None], scale_factor=FINER, mode="trilinear")[0, 0]
    grid = Grid(tuple(density.shape), volume.grid.lower, volume.grid.upper)
    finer = Volume(grid, density, volume.sigma_a, volume.sigma_s, volume.phase)
    return replace(scene, volume=finer, render=RenderSettings(4, 2, 0.0))


def error(image: Tensor, truth: Tensor) -> float:
    """The relative RMS error of `image`."""
    return float((image - truth).norm() / truth.norm())


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-g", type=float, action="append")
    parser.add_argument("--depth", type=float, action="append")
    parser.add_argument("--samples", type=int, default=8)
    given = parser.parse_args()
    columns = " | ".join(f"n = {rounds}" for rounds in ROUNDS)
    print(f"| g | depth of a cell | lit from the | {columns} |\n|{'---|' * (3 + len(ROUNDS))}")
    for g in given.g or (-0.8, -0.4, 0.0, 0.4, 0.8):
        for depth in given.depth or (1.0, 4.0, 8.0, 20.0):
            for lit in LIGHTS:
                with torch.no_grad():
                    fine = refine(coarse_scene(g, depth, lit, transport_rounds=5, degree=5))
                    truth = render(fine)
                    scenes = (
                        coarse_scene(g, depth, lit, given.samples, transport_rounds=n, degree=3)
                        for n in ROUNDS
                    )
                    errors = (f"{error(render(scene), truth):.3f}" for scene in scenes)
                    print(f"| {g} | {depth:g} | {lit} | {' | '.join(errors)} |", flush=True)


if __name__ == "__main__":
    main()
