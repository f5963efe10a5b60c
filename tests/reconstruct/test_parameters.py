"""Parameters: their smoothing, their bounds, and what they keep at a finer resolution."""

import math
from dataclasses import replace

import pytest
import torch
from media import box_grid, make_scene, random_values

from ddrecon.grid import Grid
from ddrecon.medium.coefficients import resample
from ddrecon.reconstruct.parameters import (
    Parameter,
    by_coordinates,
    face_stiffness,
    total_variation,
)
from ddrecon.settings import ParameterSettings

GRID = box_grid((4, 6, 5))


def test_values_stay_within_bounds_and_support_and_what_would_leave_them_is_not_free():
    value = random_values(*GRID.shape) - 0.5
    parameter = Parameter("density", ParameterSettings(max=0.3), value, GRID)
    parameter.restrict(random_values(*GRID.shape, seed=1) > 0.5)
    held, slope = parameter.project(value), random_values(*GRID.shape, seed=2) - 0.5
    assert 0 <= float(held.min()) < float(held.max()) <= 0.3
    assert torch.equal(parameter.project(held), held)
    is_free = parameter.free(held, slope) > 0
    step = 1e-3 * slope.sign()
    moved = parameter.project(held - step)
    torch.testing.assert_close(moved, torch.where(is_free, held - step, held))
    assert bool(is_free.any())


def test_a_direction_keeps_its_length():
    value = torch.tensor([1.0, -2.0, 2.0])
    parameter = Parameter("lights.0.direction", ParameterSettings(), value, GRID)
    moved = parameter.project(value + torch.tensor([0.3, 0.1, -0.2]))
    assert float(moved.norm()) == pytest.approx(3.0)


def test_what_a_move_changes_is_the_same_at_a_finer_resolution():
    """The product of a move and of a change of the derivative, but for the blur of both."""

    def miss(cells):
        grid, finer = box_grid((cells, 2, 3)), box_grid((2 * cells, 4, 5))
        place = (torch.arange(cells).double() + 0.5) / cells
        move, slope = (w[:, None, None].expand(grid.shape) for w in (place.sin(), place.exp()))
        parameter = Parameter("density", ParameterSettings(), move, grid)
        parameter.refine(finer)
        product = (parameter.carry(move, False) * parameter.carry(slope, True)).sum()
        return abs(float(product / (move * slope).sum()) - 1)

    assert miss(16) > 3.5 * miss(32) > 0


def test_a_finer_field_keeps_the_means_of_the_coarser_to_fourth_order():
    """Interpolation alone blurs by the second power of a cell's width."""

    def lost(cells):
        grid, finer = box_grid((cells, 2, 2)), box_grid((2 * cells, 4, 4))
        place = (torch.arange(cells).double() + 0.5) / cells
        wave = (2 + (2 * math.pi * place).cos())[:, None, None].expand(grid.shape)
        parameter = Parameter("density", ParameterSettings(), wave, grid)
        parameter.refine(finer)
        return float((resample(parameter.value.detach(), grid) - wave).abs().max())

    assert lost(16) > 14 * lost(32) > 0


def box(cells, side=1.0):
    return Grid((cells,) * 3, (0.0,) * 3, (side,) * 3)


@pytest.mark.parametrize("cells", [8, 16, 32])
def test_total_variation_of_a_ramp_is_its_slope_at_any_resolution(cells):
    grid = box(cells)
    ramp = 2 * grid.centers(torch.zeros(1, dtype=torch.float64))[2].expand(*grid.shape)
    inner = (cells - 1) / cells
    assert float(total_variation(ramp, grid)) == pytest.approx(2 * inner, rel=0.01)


def test_total_variation_does_not_depend_on_world_scale():
    field = random_values(6, 6, 6)
    one, other = (float(total_variation(field, box(6, side))) for side in (1.0, 7.0))
    assert one == pytest.approx(other, rel=1e-12)


@pytest.mark.parametrize("knee", [None, 0.1])
def test_total_variation_has_a_finite_derivative_where_flat(knee):
    field = torch.zeros(4, 4, 4, requires_grad=True)
    total_variation(field, box(4), knee).backward()
    assert torch.isfinite(field.grad).all()


def test_a_knee_compresses_densities_above_it():
    """By log(1 + x / knee) / 3; the derivative is exact."""
    field, grid = random_values(3, 4, 5).requires_grad_(), Grid((3, 4, 5), (0, 0, 0), (1, 1, 1))
    compressed = total_variation((1 + field / 0.1).log() / 3, grid)
    torch.testing.assert_close(total_variation(field, grid, 0.1), compressed)
    assert torch.autograd.gradcheck(lambda x: total_variation(x, grid, 0.1), field)


def make_glow(density, emission, grid=GRID):
    """An emission beside a density, in units of their own."""
    medium = Parameter("density", ParameterSettings(tv=0.0), density, grid, unit=0.3)
    glow = Parameter("emission", ParameterSettings(tv=1.0), emission, grid, unit=0.7)
    glow.glow_in(medium)
    return glow


def cost(*fields):
    return float(make_glow(*fields).penalty().detach())


def test_an_emission_that_follows_its_medium_costs_nothing():
    density = 1e4 * random_values(*GRID.shape)
    assert cost(density, density) < 1e-4 * cost(density, density.flip(0))


def test_what_has_no_mass_costs_more_where_it_glows():
    """The same light, within smoke and beside it."""
    density, light = torch.zeros(2, 8, 4, 4).double()
    density[:4], light[1:3, 1:3, 1:3] = 3.0, 0.1
    grid = box_grid((8, 4, 4))
    assert cost(density, light.flip(0), grid) > 2 * cost(density, light, grid)


def test_derivatives_for_each_optical_depth_are_those_of_the_same_function():
    """By a density, what glows for each depth of it held, and by that: of colors in one medium."""
    density, emission = random_values(*GRID.shape), random_values(3, *GRID.shape, seed=1)
    glow = make_glow(density, emission)
    glow.is_per_depth = True
    names = glow.medium.name, glow.name

    def value(density, source):
        return (density.sin() * (source * glow.depth(density)).square()).sum()

    coordinates = [x.clone().requires_grad_() for x in (density, glow.coordinate)]
    torch.testing.assert_close(coordinates[1] * glow.depth(density), emission)
    wanted = torch.autograd.grad(value(*coordinates), coordinates)
    fields = [x.clone().requires_grad_() for x in (density, emission)]
    bars = torch.autograd.grad((fields[0].sin() * fields[1].square()).sum(), fields)
    turned = by_coordinates([glow, glow.medium], dict(zip(names, bars, strict=True)))
    torch.testing.assert_close([turned[name] for name in names], list(wanted))


def stiffness_matrix(field, grid, knee):
    """R, column by column."""
    faces, slope = face_stiffness(field, grid, knee)
    slope = torch.ones_like(field) if slope is None else slope
    columns = []
    for entry in torch.eye(field.numel()).double().view(-1, *field.shape):
        total, x = torch.zeros_like(field), entry * slope
        for axis, face in enumerate(faces, -3):
            flow = face * (x.roll(-1, axis) - x)
            total += flow.roll(1, axis) - flow
        columns.append((total * slope).flatten())
    return torch.stack(columns, 1)


@pytest.mark.parametrize("periodic", [(), (0, 2)])
def test_stiffness_is_of_a_parabola_that_touches_total_variation_from_above(periodic):
    field = random_values(4, 3, 5)
    grid = replace(make_scene(field).volume.grid, periodic=periodic)
    stiffness = stiffness_matrix(field, grid, None)
    field.requires_grad_()
    variation = total_variation(field, grid)
    (slope,) = torch.autograd.grad(variation, field)
    for seed in range(40):
        for size in (-1.0, 0.3, 2.0):
            step = size * (random_values(*field.shape, seed=seed) - 0.5).flatten()
            parabola = variation + slope.flatten() @ step + step @ stiffness @ step / 2
            assert total_variation(field + step.view_as(field), grid) <= parabola + 1e-12


def test_smoothing_does_not_depend_on_where_a_period_begins():
    field, shift = random_values(4, 3, 5), (1, 2)
    grid = replace(make_scene(field).volume.grid, periodic=(0, 2))
    moved = field.roll(shift, (0, 2))
    torch.testing.assert_close(total_variation(moved, grid), total_variation(field, grid))
    for there, here in zip(
        face_stiffness(moved, grid)[0], face_stiffness(field, grid)[0], strict=True
    ):
        torch.testing.assert_close(there, here.roll(shift, (0, 2)))


@pytest.mark.parametrize("density", [0.0, 0.05, 2.0])
def test_stiffness_is_the_curvature_of_an_even_density(density):
    field = torch.full((3, 4, 5), density, dtype=torch.float64)
    grid = make_scene(field).volume.grid

    def variation(x):
        return total_variation(x.view(3, 4, 5), grid, 0.1)

    curvature = torch.autograd.functional.hessian(variation, field.flatten())
    torch.testing.assert_close(stiffness_matrix(field, grid, 0.1), curvature)
