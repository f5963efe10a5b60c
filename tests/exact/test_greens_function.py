"""Light from a point of an infinite medium: exp(-r / L) / (4 pi D r), L = sqrt(D / kappa_a)."""

import math

import torch
from media import convergence_order, make_operator

from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.grid import Grid

DIFFUSION = 0.3
LENGTH = 0.06
"""L [u]: the faces of the unit box are so far away that the medium might as well have none."""
NEAR, FAR = 0.1, 0.22


def error(cells: tuple[int, int, int]) -> float:
    """The relative RMS error between NEAR and FAR of a source of power 1 in the middle cell."""
    grid = Grid(cells, (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    diffusion = torch.full((1, *cells), DIFFUSION, dtype=torch.float64)
    source = torch.zeros_like(diffusion)
    source[0, cells[0] // 2, cells[1] // 2, cells[2] // 2] = 1 / math.prod(grid.spacing)
    operator = make_operator(grid, diffusion, torch.full_like(diffusion, DIFFUSION / LENGTH**2))
    found = solve_by_multigrid(operator, source, None, 1e-10).value[0]
    distance = sum(axis**2 for axis in grid.centers(source)).sqrt()
    exact = torch.exp(-distance / LENGTH) / (4 * math.pi * DIFFUSION * distance)
    is_counted = (distance > NEAR) & (distance < FAR)
    return float((found - exact)[is_counted].norm() / exact[is_counted].norm())


def test_light_from_a_point_falls_off_as_it_must():
    assert error((25, 27, 23)) < 0.08


def test_the_greens_function_is_approached_at_second_order():
    counts = [25, 35, 49]
    errors = [error((cells, cells, cells)) for cells in counts]
    assert errors[-1] < 0.02, errors
    assert convergence_order([1 / cells for cells in counts], errors) > 1.8, errors
