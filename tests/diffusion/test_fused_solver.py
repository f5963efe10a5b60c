"""The fused kernels of multigrid compute what PyTorch's operations compute, as often as those."""

import pytest
import torch
from media import assert_near, random_values
from test_multigrid import FORMS, patchy, patchy_box, uneven
from torch import Tensor

from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solvers.hierarchy import Level
from ddrecon.diffusion.solvers.multigrid import solve_by_multigrid
from ddrecon.diffusion.solvers.scaled import Solution
from ddrecon.engine import use_engine

pytest.importorskip("warp", reason="warp-lang is not installed (extra `fast`)")
from ddrecon.diffusion.solvers.fused import multigrid as fused
from ddrecon.diffusion.solvers.fused.hierarchy import Hierarchy

pytestmark = pytest.mark.slow

SHAPES = [(1, 1, 1), (1, 1, 9), (1, 12, 17), (9, 1, 1), (2, 3, 40), (7, 8, 9), (16, 5, 11)]


def solve(
    engine: str, operator: Operator, source: Tensor, tolerance: float, guess: Tensor | None = None
) -> Solution:
    use_engine(engine)
    return solve_by_multigrid(
        Operator(operator.conductances, operator.loss), source, guess, tolerance
    )


def cycle(operator: Operator, source: Tensor) -> Tensor:
    """One cycle of the fused kernels for `source` as the residual."""
    use_engine("warp")
    run = fused.Run(operator, source / operator.once(Hierarchy.of).scale, None, -1.0)
    run.iterate(1)
    return run.vector("P").clone()


@pytest.mark.parametrize("shape", SHAPES[1:], ids=str)
@pytest.mark.parametrize("colors", [1, 2])
def test_a_cycle_is_that_of_torch(shape: tuple[int, int, int], colors: int):
    """But for a single cell, which needs none."""
    operator = patchy_box(shape)
    operator = Operator(tuple(c[:colors] for c in operator.conductances), operator.loss[:colors])
    source = random_values(colors, *shape, seed=4) - 0.5
    assert_near(cycle(operator, source), Level.of(operator).cycle(source), 1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_grids_are_those_of_torch(form: str):
    """The same axes are coarsened on every level, also where cells are not cubes."""
    shape, sides = FORMS[form]
    operator = uneven(shape, sides)
    source = random_values(2, *shape, seed=4) - 0.5
    assert_near(cycle(operator, source), Level.of(operator).cycle(source), 1e-12)


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
    exact = solve("torch", Operator(*map(doubled, (operator.conductances, operator.loss))),
                  source.double(), 1e-12).value  # fmt: skip
    errors = [float((u.value - exact).norm()) for u in (found, known)]
    assert errors[0] <= 2 * errors[1]


def doubled(tensors: Tensor | tuple[Tensor, ...]):
    return tensors.double() if isinstance(tensors, Tensor) else tuple(c.double() for c in tensors)


@pytest.mark.parametrize("losses", [1, 3])
def test_colors_share_conductances(losses: int):
    operator, source = uneven((6, 9, 7)), random_values(3, 6, 9, 7)
    loss = operator.loss[:1] + torch.arange(losses, dtype=torch.float64).view(-1, 1, 1, 1)
    shared = Operator(tuple(c[:1] for c in operator.conductances), loss)
    found, known = (solve(engine, shared, source, 1e-10) for engine in ("warp", "torch"))
    assert found.iterations == known.iterations
    assert_near(found.value, known.value, 1e-8)
