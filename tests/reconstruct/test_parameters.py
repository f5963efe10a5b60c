"""Steps of fields: closed forms, units, and a new beginning at each resolution."""

from __future__ import annotations

import torch
from media import box_grid, random_values

from ddrecon.reconstruct.parameters import BETAS, FLOOR, Parameter
from ddrecon.settings import ParameterSettings

GRID = box_grid((4, 6, 5))
RATE = 1e-3


def start() -> Parameter:
    """A field far from its bounds."""
    value = 1 + random_values(*GRID.shape, seed=1)
    return Parameter("density", ParameterSettings(), RATE, value, GRID)


def test_the_first_step_goes_ahead_of_the_derivative_over_its_floored_size() -> None:
    parameter, gradient = start(), random_values(*GRID.shape) - 0.5
    before = parameter.value.detach()
    parameter.step(gradient, 1.0)
    size = gradient.abs() + FLOOR * gradient.square().mean().sqrt()
    moved = before - RATE * (1 + BETAS[0]) * gradient / size
    torch.testing.assert_close(parameter.value.detach(), moved)


def test_steps_do_not_depend_on_the_unit_of_the_objective() -> None:
    one, other = start(), start()
    for seed in range(3):
        gradient = random_values(*GRID.shape, seed=seed) - 0.5
        one.step(gradient, 1.0)
        other.step(1e-4 * gradient, 1.0)
    torch.testing.assert_close(one.value, other.value)


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
