"""Operators of the printed scheme, and scenes that suit it."""

from __future__ import annotations

from typing import Any

import torch
from media import make_scene, random_values

from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory
from ddrecon.diffusion.paper.iteration import iterate_jacobi
from ddrecon.diffusion.paper.operator import PrintedOperator, Stencils, convolve, extend
from ddrecon.diffusion.paper.printed import Ghosts
from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
from ddrecon.scene import Scene

DARK = torch.zeros(1, 1, 1, 1, dtype=torch.float64)


def solving(tolerance: float = 1e-14, memory: SolveMemory | None = None) -> SolverWithMemory:
    return SolverWithMemory(iterate_jacobi, tolerance, memory or SolveMemory())


def make_printed(grid: Grid, contrast: float = 2.0, colors: int = 2) -> PrintedOperator:
    """The operator of a medium whose kappa varies by `contrast` from cell to cell, at random."""
    kappa = 0.1 * contrast ** random_values(colors, *grid.shape, seed=1)
    stencils = Stencils.on(grid, kappa)
    diagonal = 3 * random_values(colors, *grid.shape, seed=2) + kappa * sum(
        2 / h**2 for h in grid.spacing
    )
    echo = Ghosts.of(kappa, Moments(torch.zeros_like(kappa)), DARK, stencils).echo
    return PrintedOperator(stencils, diagonal, convolve(extend(kappa), stencils.coefficients), echo)


def smooth_scene(cells: int = 6, **changes: Any) -> Scene:
    """A medium that varies slowly and touches its box, in beams and ambient light."""
    grid = Grid((cells, cells, cells), (-0.5, -0.6, -0.4), (0.5, 0.6, 0.5))
    z, y, x = grid.centers(torch.zeros(1, dtype=torch.float64))
    density = 1 + 0.4 * torch.sin(2 * z + x) * torch.cos(y)
    lights = {"directional": (3.0, 2.0, 1.0), "ambient": (0.3, 0.4, 0.5)}
    settings = {"g": 0.4, "scheme": "printed"} | lights | changes
    return make_scene(density, grid=grid, **settings)
