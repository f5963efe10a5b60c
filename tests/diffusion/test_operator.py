"""The diffusion operator: a symmetric M-matrix that keeps energy, of second order."""

import math

import pytest
import torch
from manufactured import EXTENT, manufactured
from media import box_grid, convergence_order, dense_matrix, make_operator, random_values, tensor
from torch import Tensor

from ddrecon.diffusion.operator import (
    AXES,
    Operator,
    boundary_loss,
    face_fluxes,
)
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.grid import Grid

SHAPES = [(4, 3, 5), (1, 4, 3), (3, 1, 4), (4, 3, 1), (1, 1, 5), (1, 1, 1)]


@pytest.fixture(params=SHAPES, ids=str)
def grid(request) -> Grid:
    return box_grid(request.param)


@pytest.fixture
def diffusion(grid: Grid) -> Tensor:
    """Diffusion coefficients over four decades, two colors."""
    return 10 ** (4 * random_values(2, *grid.shape, seed=1) - 3)


@pytest.fixture
def absorption(grid: Grid) -> Tensor:
    return random_values(2, *grid.shape, seed=2)


@pytest.fixture
def operator(grid: Grid, diffusion: Tensor, absorption: Tensor) -> Operator:
    return make_operator(grid, diffusion, absorption)


def test_the_operator_is_the_matrix_written_with_loops(operator: Operator):
    u, matrix = random_values(*operator.loss.shape), dense_matrix(operator)
    expected, diagonal = (
        (matrix @ u.flatten(1)[..., None]).view_as(u),
        torch.linalg.diagonal(matrix),
    )
    torch.testing.assert_close(operator.apply(u), expected, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(operator.diagonal.flatten(1), diagonal, rtol=1e-14, atol=0)


@pytest.mark.parametrize("has_outside", [False, True])
@pytest.mark.parametrize("has_source_flux", [False, True])
def test_energy_is_kept(
    grid: Grid, diffusion: Tensor, absorption, operator, has_source_flux: bool, has_outside: bool
):
    """Absorbed plus leaked, less what came in, is what was injected: source_flux only moves."""
    injected = random_values(2, *grid.shape, seed=5)
    flux = [random_values(2, *grid.shape, seed=6 + axis) - 0.5 for axis in AXES]
    source_flux = flux if has_source_flux else [None] * 3
    outside = tensor(0.7, 1.3).view(2, 1, 1, 1) if has_outside else None
    source = injected + boundary_loss(diffusion, grid) * outside if has_outside else injected
    for axis in AXES:
        faces = face_fluxes(None, source_flux[axis - 1], diffusion, grid, axis)
        source = source - faces.diff(dim=axis) / grid.spacing[axis - 1]
    u = torch.linalg.solve(dense_matrix(operator), source.flatten(1)).view_as(source)
    volume, leaked = math.prod(grid.spacing), torch.zeros(2, dtype=torch.float64)
    for axis, step in zip(AXES, grid.spacing, strict=True):
        faces = face_fluxes(u, source_flux[axis - 1], diffusion, grid, axis, outside)
        faces = faces.movedim(axis, 0)
        leaked += (faces[-1] - faces[0]).sum((1, 2)) * volume / step
    absorbed, given = ((one * volume).sum((1, 2, 3)) for one in (absorption * u, injected))
    torch.testing.assert_close(absorbed + leaked, given, rtol=1e-10, atol=0)


def test_light_that_is_the_same_outside_and_inside_does_not_flow(grid: Grid, diffusion: Tensor):
    radiance = tensor(0.7, 1.3).view(2, 1, 1, 1)
    inside = radiance.expand_as(diffusion)
    for axis in AXES:
        assert not face_fluxes(inside, None, diffusion, grid, axis, radiance).any()


def discrete_error(cells: int) -> float:
    grid = Grid((cells, cells, cells // 2), (0.0, 0.0, 0.0), EXTENT)
    u, diffusion, absorption, source, *flux = manufactured(
        torch.broadcast_tensors(*grid.centers(tensor(0)))
    )
    for axis in AXES:
        faces = face_fluxes(None, flux[axis - 1], diffusion, grid, axis)
        source = source - faces.diff(dim=axis) / grid.spacing[axis - 1]
    operator = make_operator(grid, diffusion, absorption)
    error = solve_by_multigrid(operator, source, None, 1e-11).value - u
    return float((error**2).mean().sqrt() / (u**2).mean().sqrt())


def test_a_manufactured_solution_is_approached_at_second_order():
    counts = [8, 16, 32]
    errors = [discrete_error(cells) for cells in counts]
    assert convergence_order([1 / cells for cells in counts], errors) >= 1.9, errors
