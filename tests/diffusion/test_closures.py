"""Closures: D of dense media and of empty space; means in cells and values at centers (E2.12)."""

import math

import numpy as np
import pytest
import torch
from media import box_grid, half_empty, random_values
from torch import Tensor

from ddrecon.diffusion.cells import average, average_cells, sharpen
from ddrecon.diffusion.closures import CLOSURES, FLOOR, geometric, inverse_distance
from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.reduced import receive_light
from ddrecon.medium.coefficients import Coefficient, Volume, scale_medium

each_closure = pytest.mark.parametrize("closure", CLOSURES.values(), ids=CLOSURES.keys())


@each_closure
def test_the_coefficient_is_positive_and_falls_to_a_third_of_the_transport_length(closure):
    kappa = torch.logspace(-8, 10, 37, dtype=torch.float64).view(-1, 1, 1, 1).expand(-1, 2, 3, 4)
    coefficient = closure(kappa, box_grid((2, 3, 4)))
    assert bool((coefficient > 0).all()) and bool((coefficient.diff(dim=0) <= 0).all())
    torch.testing.assert_close(coefficient[-1], 1 / (3 * kappa[-1]), rtol=1e-8, atol=0)


@each_closure
def test_derivatives_are_finite_and_those_of_differences_also_in_empty_space(closure):
    grid = box_grid((2, 3, 2))
    empty = torch.zeros(1, *grid.shape, requires_grad=True)
    (slope,) = torch.autograd.grad(closure(empty, grid).sum(), empty)
    assert bool(slope.isfinite().all())
    kappa: Tensor = (10 * half_empty(2, *grid.shape)).requires_grad_()
    modes = {"atol": 1e-8, "check_forward_ad": True}
    assert torch.autograd.gradcheck(lambda k: closure(k, grid), kappa, **modes)


def test_the_smooth_floor_is_that_of_a_box_of_fixed_optical_thickness():
    grid = box_grid((2, 3, 4))
    empty = CLOSURES["smooth"](torch.zeros(1, *grid.shape, dtype=torch.float64), grid)
    thickness = min(grid.extent) / (3 * empty)
    torch.testing.assert_close(thickness, torch.full_like(empty, FLOOR), rtol=1e-14, atol=0)


def mean_inverse_distance(grid, points, part=1.0):
    """That of the origin to a cell, `part` of it wide, at `points` [N, 3], by Gauss-Legendre."""
    nodes, weights = (torch.from_numpy(one) for one in np.polynomial.legendre.leggauss(12))
    size = part * torch.tensor(grid.spacing, dtype=torch.float64)
    within = torch.cartesian_prod(nodes, nodes, nodes) / 2 * size
    weight = torch.cartesian_prod(weights, weights, weights).prod(1) / 8
    return (1 / (points[:, None] + within).norm(dim=-1)) @ weight


def test_distances_are_those_summed_cell_by_cell():
    grid = box_grid((3, 4, 2))
    weight: Tensor = half_empty(2, *grid.shape) + 0.03 / sum(grid.extent)
    places = torch.stack([c.expand(grid.shape) for c in grid.centers(weight)]).flatten(1).mT
    inverse = mean_inverse_distance(grid, (places[:, None] - places).flatten(0, 1)).view(24, 24)
    # of a cell to its own middle: its 27 parts, one of which is three times as near
    thirds = torch.cartesian_prod(*[torch.tensor([-1.0, 0, 1]).double()] * 3)
    thirds = thirds[thirds.abs().sum(1) > 0] / 3 * torch.tensor(grid.spacing)
    inverse.fill_diagonal_(mean_inverse_distance(grid, thirds, 1 / 3).sum() / 24)
    flat = weight.flatten(1)
    expected = (flat @ inverse / flat.sum(1, keepdim=True)).view_as(weight)
    without_haze = Coefficient(torch.ones(()), weight - 0.03 / sum(grid.extent))
    found = inverse_distance([without_haze], grid)
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=0)


def test_in_layers_that_repeat_the_distance_is_the_thickness_of_those_that_have_a_medium():
    grid = Grid((4, 3, 2), (0, 0, 0), (2.0, 3.0, 1.0), periodic=(1, 2))
    weight = torch.zeros(1, *grid.shape, dtype=torch.float64)
    weight[:, 1:3] = 50 * random_values(2, 3, 2)
    actual = inverse_distance([Coefficient(torch.ones(()), weight)], grid)
    expected = torch.tensor([0.0, 1, 1, 0], dtype=torch.float64).view(1, 4, 1, 1)
    torch.testing.assert_close(actual, expected.expand_as(actual), rtol=0, atol=0.01)


def test_flat_cells_have_distances_of_their_shape():
    """A plate of 2 w by 2 w has the mean 1 / distance asinh(1) / (w / 2) to its middle."""
    flat = Grid((4, 1, 1), (0.0, -1.0, -1.0), (4e-4, 1.0, 1.0))
    found = inverse_distance([Coefficient(torch.ones(()), torch.ones(1, 4, 1, 1).double())], flat)
    expected = torch.full_like(found, 2 * math.asinh(1))
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=0)


@pytest.mark.parametrize(("cells", "half_side"), [(24, 0.5), (24, 1.0), (48, 0.5)])
def test_light_around_a_sphere_leaves_it_by_marshaks_condition_whatever_the_box(cells, half_side):
    """D = distance / 4 makes L0 fall as 1 / distance^2: F = L0 / 2 on the medium as on the box.

    On the finest grid distances are interpolated.
    """
    grid = Grid((cells,) * 3, (-half_side,) * 3, (half_side,) * 3)
    z, y, x = grid.centers(torch.zeros((), dtype=torch.float64))
    distance = (z * z + y * y + x * x).sqrt()[None]
    kappa, outside = 200 * (distance < 0.25).double(), distance > 0.3
    found, expected = geometric(kappa, grid)[outside], distance[outside] / 4
    torch.testing.assert_close(found, expected, rtol=0.03, atol=0)


def test_finite_differences_may_step_below_zero():
    """D stays positive there, and its slope at zero is the same from both sides."""
    kappa: Tensor = random_values(1, 3, 4, 2) * (random_values(1, 3, 4, 2, seed=1) > 0.5)
    below, above = (geometric(kappa + change, box_grid((3, 4, 2))) for change in (-1e-5, 1e-5))
    here = kappa.clone().requires_grad_()
    _, slope = torch.autograd.functional.jvp(
        lambda k: geometric(k, box_grid((3, 4, 2))), here, torch.ones_like(kappa)
    )
    torch.testing.assert_close((above - below) / 2e-5, slope, rtol=1e-7, atol=0)
    assert bool((geometric(kappa - 0.4, box_grid((3, 4, 2))) > 0).all())


def test_cells_receive_what_a_beam_loses_where_density_changes():
    """In a column: E (1 - exp(-depth)), as matter times what is received, summed."""
    grid, one = Grid((7, 1, 1), (0, 0, 0), (2.0, 1, 1)), torch.ones(1, dtype=torch.float64)
    density = torch.tensor([0, 0, 9, 30, 0.5, 0, 0], dtype=torch.float64).view(7, 1, 1)
    cells = average_cells(scale_medium(Volume(grid, density, 0.2 * one, 0.8 * one, 0 * one[0])))
    light = DirectionalLight(torch.tensor([0.0, 0, -1], dtype=torch.float64), 3 * one)
    received = 4 * math.pi * receive_light(cells, [light], 0).mean
    lost = (cells.extinction.value * received).sum() * grid.spacing[0]
    whole = density.sum() * grid.spacing[0]
    torch.testing.assert_close(lost, 3 * -torch.expm1(-whole), rtol=1e-12, atol=0)


def test_centers_of_thin_cells_are_those_whose_means_are_known():
    """Of light that bends evenly along each axis, away from the faces of the box."""
    grid, one = box_grid((6, 7, 5)), torch.ones(1, dtype=torch.float64)
    z, y, x = grid.centers(one)
    light = (2 + z - 0.3 * y + 0.5 * z**2 + 0.2 * y**2 - 0.7 * x**2)[None]
    medium = scale_medium(Volume(grid, 0 * light[0], one, one, 0 * one[0]))
    actual = sharpen(medium, average(light))
    inner = (slice(None), *[slice(2, -2)] * 3)
    torch.testing.assert_close(actual[inner], light[inner], rtol=1e-13, atol=0)
