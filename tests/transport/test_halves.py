"""Sweeps through halves of cells (E2.18) keep light, and see what cells as a whole do not."""

from dataclasses import replace

import pytest
import torch
from media import random_values

from ddrecon.diffusion.cells import average_cells
from ddrecon.grid import Grid
from ddrecon.light.lights import DirectionalLight
from ddrecon.light.moments import cut
from ddrecon.lighting import fluence
from ddrecon.medium.coefficients import Volume, resample, scale_medium
from ddrecon.scene import Scene
from ddrecon.settings import DiffusionSettings
from ddrecon.transport.halves import mean_of_halves, put_in_halves
from ddrecon.transport.sweep import sweep_change


def cells_of(density, albedo=0.9, halved="xy", periodic=(1, 2)):
    """Flat cells whose `density` is linear between their centers."""
    shape = tuple(density.shape)
    upper = (0.2 * shape[0], 1.0 * shape[1], 1.0 * shape[2])
    grid = Grid(shape, (0.0, 0.0, 0.0), upper, periodic=periodic)
    scatters = torch.full((1, 1, 1, 1), albedo).to(density)
    volume = Volume(grid, density, 1 - scatters, scatters, torch.tensor(0.5).to(density))
    return average_cells(replace(scale_medium(volume, 3), halved=halved))


@pytest.mark.parametrize("periodic", [(1, 2), ()], ids=str)
def test_halves_have_the_means_of_cells(periodic):
    cells = cells_of(random_values(3, 4, 5, dtype=torch.float64), periodic=periodic)
    halves = cells.halves
    for name in ("extinction", "remaining"):
        whole, half = (getattr(medium, name).value for medium in (cells, halves))
        torch.testing.assert_close(resample(half, cells.grid), whole)


def test_what_cells_scatter_and_lose_is_kept():
    cells = cells_of(random_values(3, 4, 5, dtype=torch.float64))
    moments = random_values(16, 1, 3, 4, 5, seed=1, dtype=torch.float64)
    halved = torch.cat(put_in_halves(cells, cells.halves, cut(moments)))
    scattered = resample(cells.halves.remaining.value * halved, cells.grid)
    lost = cells.extinction.value * mean_of_halves(cells, cells.halves, halved)
    for result, coefficient in ((scattered, cells.remaining), (lost, cells.extinction)):
        # But for what counts cells alike that have nothing.
        torch.testing.assert_close(result, coefficient.value * moments, rtol=2e-3, atol=2e-3)


def test_a_white_furnace_stays_white():
    cells = cells_of(5 * random_values(3, 4, 5, dtype=torch.float64), albedo=1.0)
    even = torch.zeros(16, 1, 3, 4, 5, dtype=torch.float64)
    even[0] = 1
    dark = torch.zeros_like(even)
    changes = sweep_change(cells, cut(even), cut(dark), even[0, :, :1, :1, :1], 44)
    assert torch.cat(changes).abs().max() < 1e-12


def test_gradients_are_finite_in_empty_space():
    density = torch.zeros(3, 4, 5, dtype=torch.float64, requires_grad=True)
    moments = random_values(16, 1, 3, 4, 5, seed=1, dtype=torch.float64)
    changes = sweep_change(cells_of(density), cut(moments), cut(moments), None, 44)
    (gradient,) = torch.autograd.grad(torch.cat(changes).sum(), density)
    assert gradient.isfinite().all() and gradient.any()


@pytest.mark.slow
def test_halves_come_closer_to_narrow_cells():
    """Towers of eight depths across, under a low sun: light in cells a ninth as wide is right."""
    towers = 40 * random_values(4, 4, 4, seed=3, dtype=torch.float64) ** 3
    grid = Grid((4, 4, 4), (0.0, 0.0, 0.0), (0.2, 1.0, 1.0), periodic=(1, 2))
    color = torch.ones(1, 1, 1, 1, dtype=torch.float64)
    volume = Volume(grid, towers, 0 * color, color, torch.tensor(0.8, dtype=torch.float64))
    sun = DirectionalLight(torch.tensor([0.9, 0.1, -0.4]).double(), torch.ones(1).double())

    def light(**settings):
        diffusion = DiffusionSettings(transport_rounds=5, degree=5, receive=3, **settings)
        return fluence(Scene(volume, [sun], [], diffusion=diffusion))

    right = light(refine=9, refine_along="xy", halve_along="none")
    whole, halves = (
        float(((light(refine=1, halve_along=along) - right) * towers).norm())
        for along in ("none", "xy")
    )
    assert halves < 0.85 * whole
