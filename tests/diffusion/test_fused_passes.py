"""Multigrid's passes as kernels compute what PyTorch's operations compute, as often as those."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from media import assert_near, random_values
from test_multigrid import FORMS, patchy, patchy_box, uneven
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solve import Solution, TensorSteps, solve_by_multigrid
from ddrecon.engine import use_engine

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from as_on_a_gpu import ORDERS, as_on_a_gpu, headers_of

from ddrecon.diffusion.fused.passes import KernelSteps

pytestmark = pytest.mark.slow

SHAPES = [(1, 1, 1), (1, 1, 9), (1, 12, 17), (9, 1, 1), (2, 3, 40), (7, 8, 9), (16, 5, 11)]


def solve(
    engine: str, operator: Operator, source: Tensor, tolerance: float, guess: Tensor | None = None
) -> Solution:
    use_engine(engine)
    return solve_by_multigrid(replace(operator, prepared={}), source, guess, tolerance)


def assert_steps_agree(operator: Operator, source: Tensor) -> None:
    """Those of an iteration, one after another: V-cycle, direction and solution, and their sums."""
    pairs = [KernelSteps(operator, source), TensorSteps(operator, source)]
    for steps in pairs:
        steps.numbers.copy_(random_values(*steps.numbers.shape, seed=2))
        steps.direction.copy_(source.flip(1))
        steps.precondition()
        steps.turn()
        steps.advance()
    names = "preconditioned", "direction", "product", "residual", "solution", "numbers"
    for name in names:
        assert_near(*(getattr(steps, name) for steps in pairs), 1e-12)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("colors", [1, 2])
@pytest.mark.parametrize("wraps", [False, True])
def test_a_cycle_is_that_of_torch(shape: tuple[int, int, int], colors: int, wraps: bool):
    operator = patchy_box(shape, wraps)
    faces = tuple(c[:colors] for c in operator.conductances)
    operator = replace(operator, conductances=faces, loss=operator.loss[:colors])
    assert_steps_agree(operator, random_values(colors, *shape, seed=4) - 0.5)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("wraps", [False, True])
def test_an_item_may_be_a_cell_in_any_order(order: str, wraps: bool):
    operator, source = patchy_box((7, 8, 9), wraps), random_values(2, 7, 8, 9, seed=4) - 0.5
    with as_on_a_gpu(order) as launched:
        assert_steps_agree(operator, source)
    assert "diffusion/fused/passes.h" in headers_of(launched)


@pytest.mark.parametrize("form", FORMS)
def test_grids_are_those_of_torch(form: str):
    """The same axes are coarsened on every level, also where cells are not cubes, and on a GPU."""
    shape, sides = FORMS[form]
    for place in (nullcontext(), as_on_a_gpu()):
        with place:
            assert_steps_agree(uneven(shape, sides), random_values(2, *shape, seed=4) - 0.5)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_solves_take_as_many_iterations_as_those_of_torch(shape: tuple[int, int, int]):
    operator, source = uneven(shape), random_values(2, *shape)
    found, known = (solve(engine, operator, source, 1e-9) for engine in ("warp", "torch"))
    assert found.iterations == known.iterations
    assert_near(found.value, known.value, 1e-7)
    again = solve("warp", operator, source, 1e-8, found.value)
    assert again.iterations == 0


@pytest.mark.parametrize("patch", [1, 4])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_million_to_one(patch: int, dtype: torch.dtype):
    operator, source = patchy(patch, 1e6, dtype), random_values(1, 16, 16, 16, dtype=dtype)
    found, known = (solve(engine, operator, source, 1e-6) for engine in ("warp", "torch"))
    assert abs(found.iterations - known.iterations) <= 0.1 * known.iterations
    doubled = Operator(tuple(c.double() for c in operator.conductances), operator.loss.double())
    exact = solve("torch", doubled, source.double(), 1e-12).value
    errors = [float((u.value - exact).norm()) for u in (found, known)]
    assert errors[0] <= 2 * errors[1]


@pytest.mark.parametrize("losses", [1, 3])
def test_colors_share_conductances(losses: int):
    operator, source = uneven((6, 9, 7)), random_values(3, 6, 9, 7)
    loss = operator.loss[:1] + torch.arange(losses, dtype=torch.float64).view(-1, 1, 1, 1)
    shared = Operator(tuple(c[:1] for c in operator.conductances), loss)
    found, known = (solve(engine, shared, source, 1e-10) for engine in ("warp", "torch"))
    assert found.iterations == known.iterations
    assert_near(found.value, known.value, 1e-8)
