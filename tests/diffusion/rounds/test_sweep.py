"""Sweeps and rounds are what loops over directions and cells make of E11 and E12."""

from __future__ import annotations

import pytest
import torch
from media import box_grid, half_empty, random_values
from plain_rays import round_by_loops, share_by_loops, sweep_by_loops

from ddrecon.diffusion.conservative import DiffusionProblem, solve_conservative
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory
from ddrecon.diffusion.rounds.sweep import sweep
from ddrecon.diffusion.rounds.transport import _transport_share, run_rounds
from ddrecon.diffusion.solvers import SOLVERS
from ddrecon.light.moments import Moments
from ddrecon.medium.coefficients import Medium, Volume, scale_medium

DIRECTIONS = 26
has_flux_or_not = pytest.mark.parametrize("has_flux", [False, True])


def gray_medium(shape: tuple[int, int, int], g: float, varies: bool = False) -> Medium:
    """Half empty, up to 12 optical depths a unit; where it `varies`, sigma_s differs by cell."""
    density = half_empty(*shape)
    sigma_a, sigma_s = torch.tensor([[1.0], [11.0]], dtype=torch.float64)
    if varies:
        sigma_s = sigma_s * (0.5 + random_values(1, *shape, seed=5))
    return scale_medium(Volume(box_grid(shape), density, sigma_a, sigma_s, density.new_tensor(g)))


def random_light(shape: tuple[int, int, int], has_flux: bool) -> Moments:
    mean, z, y, x = (random_values(1, *shape, seed=seed) for seed in range(1, 5))
    return Moments(1 + mean, (z - 0.5, y - 0.5, x - 0.5) if has_flux else None)


@has_flux_or_not
@pytest.mark.parametrize("varies", [False, True])
def test_a_sweep_is_a_loop_over_directions_and_cells(has_flux: bool, varies: bool):
    shape = (2, 3, 2)
    medium, light = gray_medium(shape, 0.4 * has_flux, varies), random_light(shape, has_flux)
    inflow = torch.full((1, 1, 1, 1), 0.3, dtype=torch.float64)
    swept = sweep(medium, light, inflow, DIRECTIONS)
    expected = sweep_by_loops(medium, light, 0.3, DIRECTIONS)
    torch.testing.assert_close(swept.mean, expected.mean, rtol=1e-12, atol=0)
    assert (swept.flux is None) == (not has_flux)
    for found, known in zip(swept.flux or (), expected.flux or (), strict=True):
        torch.testing.assert_close(found, known, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("shape", [(4, 3, 2), (1, 5, 4), (1, 1, 6), (1, 1, 1)], ids=str)
def test_the_share_of_transport_is_that_of_the_mean_step(shape: tuple[int, int, int]):
    medium = gray_medium(shape, 0.0)
    torch.testing.assert_close(
        _transport_share(medium, 50), share_by_loops(medium, 50), rtol=1e-10, atol=0
    )


@has_flux_or_not
def test_rounds_are_sweeps_by_loops_and_dense_solves(has_flux: bool):
    shape = (2, 2, 3)
    medium = gray_medium(shape, 0.4 * has_flux)
    problem = DiffusionProblem(
        medium,
        lambda extinction: 1 / (3 * extinction + 0.5),
        random_light(shape, has_flux),
        torch.full((1, 1, 1, 1), 0.3, dtype=torch.float64),
        has_flux,
    )
    solve = SolverWithMemory(SOLVERS["conjugate_gradient"], 1e-14, SolveMemory())
    expected = start = solve_conservative(problem, solve)
    for rounds in (1, 2):
        expected = round_by_loops(problem, expected, DIRECTIONS)
        light = run_rounds(problem, start, solve, rounds, DIRECTIONS)
        torch.testing.assert_close(light.mean, expected.mean, rtol=1e-10, atol=0)
        for found, known in zip(light.flux or (), expected.flux or (), strict=True):
            torch.testing.assert_close(found, known, rtol=1e-9, atol=1e-11)
