"""Steps of fields: closed forms, units, stability, and a new beginning at each resolution."""

import math

import pytest
import torch
from media import box_grid, random_values
from torch import Tensor

from ddrecon.reconstruct.levels import resample
from ddrecon.reconstruct.parameters import Parameter
from ddrecon.reconstruct.tuning import BETAS, FLOOR, STIFFNESS, WARM_UP
from ddrecon.settings import ParameterSettings

GRID = box_grid((4, 6, 5))
RATE = 1e-3
FIRST = RATE / WARM_UP


def start() -> Parameter:
    """A field far from its bounds."""
    value = 1 + random_values(*GRID.shape, seed=1)
    return Parameter("density", ParameterSettings(), RATE, value, GRID)


def test_steps_do_not_depend_on_the_unit_of_the_objective() -> None:
    one, other = start(), start()
    for seed in range(3):
        gradient = random_values(*GRID.shape, seed=seed) - 0.5
        one.step(gradient, 1.0)
        other.step(1e-12 * gradient, 1.0)
    torch.testing.assert_close(one.value, other.value)


def test_a_step_counts_the_curvature_of_smoothing_where_a_field_is_even() -> None:
    value, power = torch.full(GRID.shape, 0.2, dtype=torch.float64), 7.0
    parameter = Parameter("density", ParameterSettings(tv=0.1), RATE, value, GRID)
    gradient = random_values(*GRID.shape) - 0.5

    def penalty(field: Tensor) -> Tensor:
        parameter.value = field.view(GRID.shape)
        return power * parameter.penalty()

    hessian = torch.autograd.functional.hessian(penalty, value.flatten())
    parameter.value = value
    parameter.step(gradient, 1.0, power)
    size = gradient.abs() + FLOOR * gradient.square().mean().sqrt()
    size += STIFFNESS * FIRST * hessian.diagonal().view(GRID.shape)
    torch.testing.assert_close(
        parameter.value.detach(), value - FIRST * (1 + BETAS[0]) * gradient / size
    )


def descend(start: Tensor, target: Tensor, weight: float) -> Tensor:
    """The density after 30 steps towards `target`, with smoothing."""
    grid = box_grid(tuple(start.shape))
    parameter = Parameter("density", ParameterSettings(), 0.1, start, grid)
    for _ in range(30):
        value = parameter.value
        loss = parameter.penalty() + weight * (value - target).square().mean()
        parameter.step(torch.autograd.grad(loss, value)[0], 1.0, 1.0)
    return parameter.value.detach()


def test_a_field_that_smoothing_alone_moves_becomes_even() -> None:
    start = 0.5 + 1e-4 * random_values(6, 6, 6)
    assert descend(start, start, 0.0).std() < 0.3 * start.std()


@pytest.mark.parametrize("weight", [1e-3, 1e-1])
def test_steps_do_not_amplify_what_a_start_differs_by(weight: float) -> None:
    start, change = torch.zeros(8, 8, 8, dtype=torch.float64), 1e-6 * random_values(8, 8, 8, seed=2)
    target = 0.5 * (random_values(8, 8, 8, seed=1) > 0.7)
    ends = [descend(value, target, weight) for value in (start, start + change)]
    assert (ends[1] - ends[0]).abs().max() < 30 * change.max()


def test_cells_without_a_derivative_stay() -> None:
    parameter = start()
    before = parameter.value.detach()
    for gradient in (torch.zeros_like(before), random_values(*GRID.shape) * (before > 1.5)):
        parameter.step(gradient, 1.0)
    still = before <= 1.5
    assert torch.equal(parameter.value[still], before[still]) and still.any()
    assert not torch.equal(parameter.value, before)


def test_a_finer_field_begins_as_if_it_had_never_moved() -> None:
    finer = box_grid((8, 12, 10))
    moved = start()
    moved.step(random_values(*GRID.shape), 1.0)
    moved.refine(finer)
    value = moved.value.detach()
    fresh = Parameter("density", ParameterSettings(), RATE, value, finer)
    for parameter in (moved, fresh):
        parameter.step(random_values(*finer.shape), 1.0)
    assert torch.equal(moved.value, fresh.value)


def test_a_finer_field_keeps_the_means_of_the_coarser_to_fourth_order() -> None:
    """Interpolation alone blurs by the second power of a cell's width."""

    def lost(cells: int) -> float:
        grid, finer = box_grid((cells, 2, 2)), box_grid((2 * cells, 4, 4))
        place = (torch.arange(cells).double() + 0.5) / cells
        wave = (2 + (2 * math.pi * place).cos())[:, None, None].expand(grid.shape)
        parameter = Parameter("density", ParameterSettings(), RATE, wave, grid)
        parameter.refine(finer)
        return float((resample(parameter.value.detach(), grid) - wave).abs().max())

    assert lost(16) > 14 * lost(32) > 0
