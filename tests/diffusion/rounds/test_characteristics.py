"""Radiance along one direction: closed forms, a slow twin, symmetry under reversal, and derivatives
in both modes.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from media import box_grid, half_empty, random_values
from torch import Tensor

from ddrecon.diffusion.rounds.characteristics import Course, follow, radiance_along
from ddrecon.grid import Grid
from ddrecon.light.moments import Moments
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


def random_light(grid: Grid, colors: int = 1) -> Moments:
    mean, z, y, x = (random_values(colors, *grid.shape, seed=seed) for seed in range(4))
    return Moments(1 + mean, (z - 0.5, y - 0.5, x - 0.5))


def at_previous(values: Tensor, point: list[float], edge: float | None) -> float:
    """`values` [z, y, x] at a fractional cell index, at least one of which is whole; beyond the box
    `edge`, or the nearest cell's.
    """
    total = 0.0
    for corner in product((0, 1), repeat=3):
        cell, weight = [math.floor(p) + c for p, c in zip(point, corner, strict=True)], 1.0
        for p, c in zip(point, corner, strict=True):
            weight *= (p % 1) if c else 1 - p % 1
        if weight == 0:
            continue
        is_outside = any(not 0 <= i < n for i, n in zip(cell, values.shape, strict=True))
        nearest = tuple(min(max(i, 0), n - 1) for i, n in zip(cell, values.shape, strict=True))
        total += weight * (edge if is_outside and edge is not None else float(values[nearest]))
    return total


def by_cells(medium: Medium, scatters: Tensor, direction: tuple[float, float, float]) -> Tensor:
    """I [z, y, x] of a gray medium, cell after cell, the integral along each step by Gauss's rule."""
    extinction, scattering = medium.extinction.value[0], medium.remaining_scattering[0]
    speed = [c / h for c, h in zip(direction, medium.grid.spacing, strict=True)]
    axis = max(range(3), key=lambda a: abs(speed[a]))
    step = 1 / abs(speed[axis])
    radiance = torch.zeros_like(extinction)
    s, weights = (torch.from_numpy(array) for array in np.polynomial.legendre.leggauss(30))
    for cell in sorted(
        product(*(range(n) for n in extinction.shape)), key=lambda c: c[axis] * speed[axis]
    ):
        point = [round(i - v * step, 12) for i, v in zip(cell, speed, strict=True)]
        depth = 0.5 * step * (float(extinction[cell]) + at_previous(extinction, point, 0.0))
        scattered = 0.5 * step * (float(scattering[cell]) + at_previous(scattering, point, 0.0))
        line = 0.5 * ((1 - s) * scatters[cell] + (1 + s) * at_previous(scatters, point, None))
        arriving = at_previous(radiance, point, 0.0) * math.exp(-depth)
        radiance[cell] = arriving + scattered * float(
            0.5 * weights @ (line * torch.exp(-0.5 * depth * (1 + s)))
        )
    return radiance


@each_direction
def test_slices_at_once_are_cells_one_by_one(direction):
    grid = box_grid((3, 4, 5))
    medium, light = medium_of(4 * random_values(3, 4, 5), grid), random_light(grid)
    scatters = light.along(tuple(torch.tensor(c, dtype=torch.float64) for c in direction))[0]
    torch.testing.assert_close(
        radiance_along(medium, light, None, direction)[0],
        by_cells(medium, scatters, direction),
        rtol=1e-12,
        atol=0,
    )


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_along_an_axis_a_uniform_medium_follows_the_closed_form(axis: int, sign: int):
    grid, albedo = box_grid((4, 5, 6)), 0.9
    medium = medium_of(torch.full((4, 5, 6), 0.7, dtype=torch.float64), grid, albedo)
    direction = tuple(float(sign * (a == axis)) for a in range(3))
    found = radiance_along(
        medium, Moments(torch.full((1, 4, 5, 6), 2.0, dtype=torch.float64)), None, direction
    )
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
    found = radiance_along(medium, Moments(room.expand(3, *grid.shape)), room, direction)
    torch.testing.assert_close(found, room.expand_as(found), rtol=1e-13, atol=0)


@each_direction
def test_turning_grid_and_direction_around_turns_the_radiance(direction):
    grid = box_grid((4, 5, 3))
    medium, light = medium_of(random_values(4, 5, 3), grid), random_light(grid)
    turned = replace(
        light, mean=light.mean.flip(1, 2, 3), flux=tuple(-part.flip(1, 2, 3) for part in light.flux)
    )
    opposite = tuple(-c for c in direction)
    found = radiance_along(
        medium_of(random_values(4, 5, 3).flip(0, 1, 2), grid), turned, None, opposite
    )
    torch.testing.assert_close(
        found.flip(1, 2, 3), radiance_along(medium, light, None, direction), rtol=1e-13, atol=0
    )


@each_direction
def test_radiance_is_never_negative_where_nothing_that_scatters_is(direction):
    grid = box_grid((6, 5, 4))
    for seed, thickness in enumerate((1e-6, 1.0, 1e3, 1e6)):
        medium = medium_of(thickness * half_empty(6, 5, 4, seed=seed), grid)
        sharp = random_values(1, *grid.shape, seed=seed) ** 20
        assert bool((radiance_along(medium, Moments(sharp), None, direction) >= 0).all())


@each_direction
def test_following_backward_is_the_adjoint_of_following(direction):
    course = Course.of(box_grid((4, 5, 6)), direction)
    laid = [
        course.lay(random_values(colors, 4, 5, 6, seed=seed))
        for seed, colors in ((0, 1), (1, 3), (2, 3))
    ]
    passed, source, received = laid[0], laid[1].requires_grad_(), laid[2]
    found = follow(passed, source, course)
    (source_bar,) = torch.autograd.grad(found, source, received)
    assert (source_bar * source).sum().item() == pytest.approx(
        (found * received).sum().item(), rel=1e-13
    )


@each_direction
@pytest.mark.parametrize("colors", [1, 3])
def test_derivatives_agree_with_differences_in_both_modes(direction, colors: int):
    grid = box_grid((3, 2, 4))
    density = (5 * half_empty(3, 2, 4)).requires_grad_()
    inputs = [
        random_light(grid, colors).mean,
        *random_light(grid, colors).flux,
        random_values(colors, 1, 1, 1),
    ]
    inputs = [tensor.clone().requires_grad_() for tensor in inputs]
    g = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)

    def radiance(
        density: Tensor, g: Tensor, mean: Tensor, z: Tensor, y: Tensor, x: Tensor, inflow: Tensor
    ) -> Tensor:
        extinction = density.new_tensor([3.0, 9.0, 20.0][:colors])
        medium = scale_medium(Volume(grid, density, 0.1 * extinction, 0.9 * extinction, g))
        return radiance_along(medium, Moments(mean, (z, y, x)), inflow, direction)

    assert torch.autograd.gradcheck(
        radiance, (density, g, *inputs), check_forward_ad=True, fast_mode=True
    )


def test_steps_across_flat_cells_are_counted_in_cells():
    course = Course.of(Grid((8, 4, 4), (0.0, 0.0, 0.0), (0.8, 4.0, 4.0)), (0.6, 0.8, 0.0))
    assert (
        course.order[0] == 1
        and course.step == pytest.approx(0.1 / 0.6)
        and course.drift == (pytest.approx(0.8 / 0.6 * 0.1), 0)
    )
