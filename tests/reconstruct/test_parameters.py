"""Parameters: their smoothing, their bounds, and what they keep at a finer resolution."""

import math

import pytest
import torch
from media import box_grid, random_values

from ddrecon.reconstruct.levels import resample
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.settings import ParameterSettings

GRID = box_grid((4, 6, 5))


def test_values_stay_within_bounds_and_support_and_what_would_leave_them_is_not_free() -> None:
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


def test_a_direction_keeps_its_length() -> None:
    value = torch.tensor([1.0, -2.0, 2.0])
    parameter = Parameter("lights.0.direction", ParameterSettings(), value, GRID)
    moved = parameter.project(value + torch.tensor([0.3, 0.1, -0.2]))
    assert float(moved.norm()) == pytest.approx(3.0)


def test_a_finer_field_keeps_the_means_of_the_coarser_to_fourth_order() -> None:
    """Interpolation alone blurs by the second power of a cell's width."""

    def lost(cells: int) -> float:
        grid, finer = box_grid((cells, 2, 2)), box_grid((2 * cells, 4, 4))
        place = (torch.arange(cells).double() + 0.5) / cells
        wave = (2 + (2 * math.pi * place).cos())[:, None, None].expand(grid.shape)
        parameter = Parameter("density", ParameterSettings(), wave, grid)
        parameter.refine(finer)
        return float((resample(parameter.value.detach(), grid) - wave).abs().max())

    assert lost(16) > 14 * lost(32) > 0
