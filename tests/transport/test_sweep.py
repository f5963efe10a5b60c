"""Sweeps and rounds are what loops over directions and cells make of E2.9 and E2.10."""

import pytest
import torch
from media import box_grid, half_empty, random_values
from plain_rays import (
    factors_by_formula,
    mean_density,
    round_by_loops,
    share_by_loops,
    sweep_by_loops,
)
from torch import Tensor

from ddrecon.diffusion.cells import average_cells
from ddrecon.diffusion.conservative import DiffusionProblem, solve_conservative
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory
from ddrecon.diffusion.solve import solve_by_multigrid
from ddrecon.light.moments import cut, fill
from ddrecon.medium.coefficients import Medium, Volume, scale_medium
from ddrecon.transport.rounds import _mean_step, _transport_share, run_rounds
from ddrecon.transport.sweep import emitted_light, steep_gradient, sweep

has_flux_or_not = pytest.mark.parametrize("has_flux", [False, True])


def gray_volume(shape: tuple[int, int, int], g: float, varies: bool = False) -> Volume:
    """Half empty, up to 12 optical depths a unit; where it `varies`, sigma_s differs by cell."""
    density = half_empty(*shape)
    sigma_a, sigma_s = torch.tensor([[1.0], [11.0]], dtype=torch.float64)
    if varies:
        sigma_s = sigma_s * (0.5 + random_values(1, *shape, seed=5))
    return Volume(box_grid(shape), density, sigma_a, sigma_s, density.new_tensor(g))


def gray_medium(shape: tuple[int, int, int], g: float, varies: bool = False) -> Medium:
    return scale_medium(gray_volume(shape, g, varies))


def random_light(shape: tuple[int, int, int], degree: int) -> Tensor:
    values = random_values((degree + 1) ** 2, 1, *shape, seed=1) - 0.5
    values[0] += 1.5
    return values


@has_flux_or_not
@pytest.mark.parametrize("varies", [False, True])
def test_a_sweep_is_a_loop_over_directions_and_cells(has_flux: bool, varies: bool):
    shape, degree = (2, 3, 2), 3 * has_flux
    medium = gray_medium(shape, 0.4 * has_flux, varies)
    source = random_light(shape, degree)
    inflow = torch.full((1, 1, 1, 1), 0.3, dtype=torch.float64)
    emitted, rise = (
        emitted_light(medium, cut(source), inflow),
        steep_gradient(medium, source[0], 26),
    )
    swept = sweep(medium.grid, medium.extinction.value, emitted, rise, 26)
    swept[0] += inflow
    expected = sweep_by_loops(medium, source, source[0, 0], 0.3, 26)
    torch.testing.assert_close(swept, expected, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("g", [0.0, 0.6])
@pytest.mark.parametrize("shape", [(4, 3, 2), (1, 5, 4), (1, 1, 6), (1, 1, 1)], ids=str)
def test_the_share_of_a_change_is_that_of_the_mean_step(shape: tuple[int, int, int], g: float):
    medium = gray_medium(shape, g)
    share = _transport_share(medium, _mean_step(medium.grid, 44))
    torch.testing.assert_close(share, share_by_loops(medium, 44), rtol=1e-6, atol=0)


@pytest.mark.parametrize("shape", [(4, 3, 2), (1, 5, 4)], ids=str)
def test_sweeps_see_the_means_of_cells(shape: tuple[int, int, int]):
    """Of each field, whether both coefficients have the same one or not."""
    for varies in (False, True):
        medium = gray_medium(shape, 0.4, varies)
        found = average_cells(medium)
        for one, mean in (
            (medium.extinction, found.extinction),
            (medium.remaining, found.remaining),
        ):
            expected = mean.scale.view(-1, 1, 1, 1) * mean_density(one.field[0])
            torch.testing.assert_close(mean.value, expected, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("g", [0.0, 0.4, -0.6])
def test_rounds_are_sweeps_by_loops_and_dense_solves(g: float):
    shape, degree = (2, 2, 3), 3 * (g != 0)
    volume = gray_volume(shape, g)
    medium = scale_medium(volume, 3)
    source = random_light(shape, degree)
    problem = DiffusionProblem(
        medium,
        lambda extinction: 1 / (3 * extinction + 0.5),
        source[:4],
        torch.full((1, 1, 1, 1), 0.3, dtype=torch.float64),
        g != 0,
    )
    solve = SolverWithMemory(solve_by_multigrid, 1e-14, SolveMemory())
    start = solve_conservative(problem, solve)
    for rounds in (1, 2):
        expected = start
        factors = factors_by_formula(g, rounds) if g and rounds > 1 else [1.0] * rounds
        for number, factor in enumerate(factors, 1):
            new = round_by_loops(
                problem, source, medium, expected, g, 3, {1: 26, 2: 44}[rounds], number == rounds
            )
            old = fill(expected, degree)
            expected = old + factor * (new - old)
        light = run_rounds(problem, source[4:], start, solve, rounds, 3)
        torch.testing.assert_close(light, expected, rtol=1e-9, atol=1e-11)
