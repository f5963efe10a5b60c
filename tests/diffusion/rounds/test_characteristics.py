"""Radiance along one direction: closed forms, a slow twin, reversal, derivatives."""

from __future__ import annotations

import pytest
import torch
from media import box_grid, half_empty, random_values
from plain_rays import by_cells
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import radiance_along
from ddrecon.grid import Grid
from ddrecon.medium.coefficients import Medium, Volume, scale_medium

DIRECTIONS = (
    (0.0, 0.0, 1.0),
    (0.0, -1.0, 0.0),
    (0.6, 0.0, -0.8),
    (-(3**-0.5),) * 3,
    (0.48, -0.36, 0.8),
    (-0.1, 0.7, -(0.5**0.5)),
)
each_direction = pytest.mark.parametrize("direction", DIRECTIONS)


def medium_of(
    density: Tensor, grid: Grid, albedo: float = 0.9, g: float = 0.0, colors: int = 1
) -> Medium:
    extinction = 4 + 3 * torch.arange(colors, dtype=density.dtype)
    return scale_medium(
        Volume(grid, density, (1 - albedo) * extinction, albedo * extinction, density.new_tensor(g))
    )


def random_source(grid: Grid, colors: int = 1) -> Tensor:
    return 1 + random_values(colors, *grid.shape, seed=1)


@each_direction
def test_slices_at_once_are_cells_one_by_one(direction):
    grid = box_grid((3, 4, 5))
    medium, scatters = medium_of(4 * random_values(3, 4, 5), grid), random_source(grid)
    torch.testing.assert_close(
        radiance_along(medium, scatters, None, direction)[0],
        by_cells(medium, scatters[0], direction),
        rtol=1e-12,
        atol=0,
    )


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_along_an_axis_a_uniform_medium_follows_the_closed_form(axis: int, sign: int):
    grid, albedo = box_grid((4, 5, 6)), 0.9
    medium = medium_of(torch.full((4, 5, 6), 0.7, dtype=torch.float64), grid, albedo)
    direction = tuple(float(sign * (a == axis)) for a in range(3))
    scatters = torch.full((1, 4, 5, 6), 2.0, dtype=torch.float64)
    found = radiance_along(medium, scatters, None, direction)
    crossed = (torch.arange(grid.shape[axis], dtype=torch.float64) + 0.5) * grid.spacing[axis]
    crossed = (crossed if sign > 0 else crossed.flip(0)).view(
        [-1 if a == axis else 1 for a in range(3)]
    )
    torch.testing.assert_close(
        found[0],
        (2 * albedo * (1 - torch.exp(-4 * 0.7 * crossed))).expand(grid.shape),
        rtol=1e-12,
        atol=0,
    )


@each_direction
def test_a_white_medium_in_a_white_room_stays_white(direction):
    grid = box_grid((5, 4, 6))
    medium = medium_of(30 * half_empty(5, 4, 6), grid, albedo=1.0, colors=3)
    room = torch.tensor([2.0, 3.0, 5.0], dtype=torch.float64).view(3, 1, 1, 1)
    found = radiance_along(medium, room.expand(3, *grid.shape), room, direction)
    torch.testing.assert_close(found, room.expand_as(found), rtol=1e-13, atol=0)


@each_direction
def test_turning_grid_and_direction_around_turns_the_radiance(direction):
    grid = box_grid((4, 5, 3))
    medium, scatters = medium_of(random_values(4, 5, 3), grid), random_source(grid)
    turned = scatters.flip(1, 2, 3)
    opposite = tuple(-c for c in direction)
    found = radiance_along(
        medium_of(random_values(4, 5, 3).flip(0, 1, 2), grid), turned, None, opposite
    )
    torch.testing.assert_close(
        found.flip(1, 2, 3), radiance_along(medium, scatters, None, direction), rtol=1e-13, atol=0
    )


@each_direction
def test_radiance_is_never_negative_where_nothing_that_scatters_is(direction):
    grid = box_grid((6, 5, 4))
    for seed, thickness in enumerate((1e-6, 1.0, 1e3, 1e6)):
        medium = medium_of(thickness * half_empty(6, 5, 4, seed=seed), grid)
        sharp = random_values(1, *grid.shape, seed=seed) ** 20
        assert bool((radiance_along(medium, sharp, None, direction) >= 0).all())


@each_direction
@pytest.mark.parametrize("colors", [1, 3])
def test_derivatives_agree_with_differences_in_both_modes(direction, colors: int):
    grid = box_grid((3, 2, 4))
    density = (5 * half_empty(3, 2, 4)).requires_grad_()
    inputs = [random_source(grid, colors), random_values(colors, 1, 1, 1)]
    inputs = [tensor.clone().requires_grad_() for tensor in inputs]
    g = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)

    def radiance(density: Tensor, g: Tensor, scatters: Tensor, inflow: Tensor) -> Tensor:
        extinction = density.new_tensor([3.0, 9.0, 20.0][:colors])
        medium = scale_medium(Volume(grid, density, 0.1 * extinction, 0.9 * extinction, g))
        return radiance_along(medium, scatters, inflow, direction)

    assert torch.autograd.gradcheck(
        radiance, (density, g, *inputs), check_forward_ad=True, fast_mode=True
    )
