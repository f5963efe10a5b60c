"""Central differences: exact on polynomials, equal to sums by index, and their transposes."""

from __future__ import annotations

import pytest
import torch
from media import box_grid, random_values
from torch import Tensor

from ddrecon.diffusion.paper.stencils import (
    Stencils,
    convolve,
    divergence,
)
from ddrecon.grid import Grid

SHAPE = (3, 4, 2)


@pytest.fixture
def grid() -> Grid:
    """Cells that are not cubes."""
    return box_grid(SHAPE)


@pytest.fixture
def extended() -> Tensor:
    return random_values(2, *(n + 2 for n in SHAPE))


def padded_centers(grid: Grid) -> list[Tensor]:
    """Coordinates z, y, x of the cells of `grid` and of the ghost cells around it."""
    lower, upper = (
        [b + sign * h for b, h in zip(bound, grid.spacing, strict=True)]
        for bound, sign in ((grid.lower, -1), (grid.upper, 1))
    )
    return Grid(tuple(n + 2 for n in grid.shape), tuple(lower), tuple(upper)).centers(
        torch.zeros(1, dtype=torch.float64)
    )


def inside(u: Tensor) -> Tensor:
    return u[..., 1:-1, 1:-1, 1:-1]


@pytest.mark.parametrize("powers", [(0, 0, 0), (1, 2, 0), (2, 1, 2), (2, 2, 2)], ids=str)
def test_gradients_of_quadratics_and_laplacians_of_cubics_are_exact(
    powers: tuple[int, int, int], grid: Grid
):
    coordinates, stencils = (
        padded_centers(grid),
        Stencils.on(grid, torch.zeros(1, dtype=torch.float64)),
    )

    def monomial(exponents: list[int]) -> Tensor:
        z, y, x = (c**n if n >= 0 else 0 * c for c, n in zip(coordinates, exponents, strict=True))
        return (z * y * x).expand([n + 2 for n in SHAPE])

    def derivative(axis: int, order: int, of: tuple[int, ...]) -> Tensor:
        factor = of[axis] * (of[axis] - 1 if order == 2 else 1)
        return factor * inside(
            monomial([n - order * (axis == other) for other, n in enumerate(of)])
        )

    gradient = convolve(monomial(list(powers))[None], stencils.gradient)[0]
    torch.testing.assert_close(
        gradient,
        torch.stack([derivative(axis, 1, powers) for axis in range(3)]),
        rtol=1e-12,
        atol=1e-12,
    )
    cubic = tuple(n + 1 for n in powers)
    neighbors = convolve(monomial(list(cubic))[None], stencils.terms)[0, 0]
    laplacian = neighbors - inside(monomial(list(cubic))) * sum(2 / h**2 for h in grid.spacing)
    torch.testing.assert_close(
        laplacian, sum(derivative(axis, 2, cubic) for axis in range(3)), rtol=1e-11, atol=1e-11
    )


def test_the_divergence_of_position_is_three_inside():
    grid = box_grid((3, 4, 5))
    z, y, x = (
        c.expand(grid.shape)[None] for c in grid.centers(torch.zeros(1, dtype=torch.float64))
    )
    stencils = Stencils.on(grid, z)
    assert not divergence([torch.ones_like(z)] * 3, stencils).any()
    found = inside(divergence([z, y, x], stencils))
    torch.testing.assert_close(found, torch.full_like(found, 3), rtol=1e-13, atol=0)
