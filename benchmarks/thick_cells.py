"""How far images are from the truth where cells are optically thick: a table in Markdown.

    python benchmarks/thick_cells.py

The truth is our own, on a grid six times as fine: the same density, linear between the centers of
the coarse grid, with angles to degree 5 and five rounds. `default` is what a scene file gets.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from accuracy import (
    FAR,
    FRONT,
    SIDE,
    Case,
    Vector,
    around,
    perspective,
    print_header,
    print_row,
    sun,
    together,
)
from torch import Tensor
from torch.nn.functional import interpolate

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Volume
from ddrecon.renderer import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import RenderSettings

CELLS, FINER, PIXELS = 12, 6, 16
BALLS = together(around((-0.13, -0.08, 0.05), 0.32, 0.2), around((0.17, 0.1, -0.05), 0.27, 0.2))
LIGHTS: dict[str, tuple[Vector, Vector]] = {
    "side": (SIDE, FRONT),
    "eye": ((2.0, -1.2, 2.2), FAR),
}
"""By where light comes from, the way it travels and the eye."""
EXACT = "diffusion.transport_rounds=5", "diffusion.degree=5"
MODELS = {
    "n = 0": ("diffusion.transport_rounds=0",),
    "n = 1, L = 1": ("diffusion.transport_rounds=1", "diffusion.degree=1"),
    "n = 1, L = 3": ("diffusion.transport_rounds=1", "diffusion.degree=3"),
    "n = 3, L = 3": ("diffusion.transport_rounds=3", "diffusion.degree=3"),
    "default, one sample": ("render.steps_per_voxel=1",),
    "default": (),
}
"""Overrides by column: n transport rounds of degree L, samples of rays as by default."""


def refine(scene: Scene) -> Scene:
    """`scene` in finer cells, two samples in each."""
    volume = scene.volume
    density = interpolate(volume.density[None, None], scale_factor=FINER, mode="trilinear")[0, 0]
    grid = Grid(tuple(density.shape), volume.grid.lower, volume.grid.upper)
    finer = Volume(grid, density, volume.sigma_a, volume.sigma_s, volume.phase)
    return replace(scene, volume=finer, render=RenderSettings(4, 2, 0.0))


def error(image: Tensor, truth: Tensor) -> float:
    """The relative RMS error of `image`."""
    return float((image - truth).norm() / truth.norm())


def print_case(g: float, depth: float, lit: str, folder: Path) -> None:
    """A row: merged balls with `depth` optical depths a cell, lit from the `side` or the `eye`."""
    travel, eye = LIGHTS[lit]
    case = Case(lit, BALLS, depth * CELLS, 0.95, g, (sun(travel),), perspective(eye, 22.0))
    path = case.write(folder, CELLS)
    views = f"views.0.camera.resolution={[PIXELS] * 2}"
    truth = render(refine(load_scene(path, overrides=(views, *EXACT))))
    errors = (
        error(render(load_scene(path, overrides=(views, *model))), truth)
        for model in MODELS.values()
    )
    print_row(g, f"{depth:g}", lit, *(f"{part:.3f}" for part in errors))


def main() -> None:
    """Prints the table."""
    print_header("g", "depth of a cell", "lit from the", *MODELS)
    with tempfile.TemporaryDirectory() as name, torch.no_grad():
        for g in (-0.8, 0.0, 0.6, 0.8):
            for depth in (1.0, 4.0, 8.0):
                for lit in LIGHTS:
                    print_case(g, depth, lit, Path(name))


if __name__ == "__main__":
    main()
