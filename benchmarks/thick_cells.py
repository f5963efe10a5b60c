"""How far images are from the truth where cells are optically thick: a table in Markdown.

    python benchmarks/thick_cells.py

The truth is our own, on a grid six times as fine: the same density, linear between the centers of
the coarse grid, with angles to degree 5 and five rounds. `default` is what a scene file gets; the
others have cells as given, or `a third` as wide. Merged balls are lit from the side or the eye;
`block` fills its box.
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
    Field,
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
from ddrecon.picture import render
from ddrecon.scene import Scene
from ddrecon.scene_file.build import load_scene
from ddrecon.settings import RenderSettings

CELLS, FINER, PIXELS = 12, 6, 16
BALLS = together(around((-0.13, -0.08, 0.05), 0.32, 0.2), around((0.17, 0.1, -0.05), 0.27, 0.2))
SHOWN: dict[str, tuple[Field, Vector, Vector]] = {
    "side": (BALLS, SIDE, FRONT),
    "eye": (BALLS, (2.0, -1.2, 2.2), FAR),
    "block": (lambda x, y, z: torch.ones_like(x * y * z), (-1.0, -1.2, -1.5), (1.3, 1.1, 2.6)),
}
"""By a name, what is lit, the way light travels and the eye."""


def by_dial(rounds: int, degree: int, times: int = 1) -> tuple[str, ...]:
    keys = {"transport_rounds": rounds, "degree": degree, "refine": times}
    return tuple(f"diffusion.{key}={value}" for key, value in keys.items())


EXACT = by_dial(5, 5)
MODELS = {
    "n = 0": by_dial(0, 1),
    "n = 1, L = 1": by_dial(1, 1),
    "n = 1, L = 3": by_dial(1, 3),
    "n = 3, L = 3": by_dial(3, 3),
    "n = 1, L = 3, a third": by_dial(1, 3, 3),
    "n = 3, L = 3, a third": by_dial(3, 3, 3),
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
    """A row: what is `SHOWN` so with `depth` optical depths a cell."""
    field, travel, eye = SHOWN[lit]
    case = Case(lit, field, depth * CELLS, 0.95, g, (sun(travel),), perspective(eye, 22.0))
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
    print_header("g", "depth of a cell", "lit from", *MODELS)
    with tempfile.TemporaryDirectory() as name, torch.no_grad():
        for g in (-0.8, 0.0, 0.6, 0.8):
            for depth in (1.0, 4.0, 8.0):
                for lit in SHOWN:
                    print_case(g, depth, lit, Path(name))


if __name__ == "__main__":
    main()
