"""Derivatives of a solve agree with differences and with each other; solves are remembered."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from media import random_values
from torch import Tensor
from torch.autograd import forward_ad

from ddrecon.diffusion import hierarchy
from ddrecon.diffusion.implicit import SolveMemory, SolverWithMemory, solve_diffusion
from ddrecon.diffusion.operator import Operator
from ddrecon.diffusion.solve import solve_by_multigrid

SHAPES = [(2, 3, 2), (1, 2, 4), (1, 1, 1), (2, 1, 2)]
MODES: dict[str, Any] = {"check_forward_ad": True, "fast_mode": True}
TO_ROUNDING = {"eps": 1e-5, "atol": 1e-8, "rtol": 1e-7, **MODES}


def solving(memory: SolveMemory | None = None) -> Callable[..., Tensor]:
    """u as a function of source, loss and the three conductances, solved to rounding."""
    solve = SolverWithMemory(solve_by_multigrid, 1e-14, memory or SolveMemory())
    return lambda source, loss, *conductances: solve_diffusion(
        solve, Operator(conductances, loss), source
    )


@pytest.fixture
def inputs():
    """source, loss and conductances of two colors, or of a gray operator under a colored source."""

    def make(shape: tuple[int, int, int] = (2, 3, 2), colors: int = 2) -> list[Tensor]:
        source, others = (
            random_values(2, *shape) - 0.5,
            [1 + random_values(colors, *shape, seed=seed) for seed in range(1, 5)],
        )
        for axis, faces in enumerate(others[1:], 1):
            faces.select(axis, -1).zero_()  # on the box
        return [source, *others]

    return make


@pytest.mark.parametrize(
    ("shape", "colors", "varied"),
    [
        *((shape, 2, range(5)) for shape in SHAPES),
        *((SHAPES[0], 2, [one]) for one in range(5)),
        (SHAPES[0], 1, range(5)),
    ],
)
def test_both_derivatives_agree_with_differences(
    shape: tuple[int, int, int], colors: int, varied: Sequence[int], inputs
):
    """By all arguments or by one; and where a gray operator serves a colored source."""
    arguments = inputs(shape, colors)
    for index in varied:
        arguments[index].requires_grad_()
    assert torch.autograd.gradcheck(solving(), arguments, **TO_ROUNDING)


def test_the_adjoint_takes_what_the_forward_solve_prepared_of_the_operator(
    inputs, monkeypatch: pytest.MonkeyPatch
):
    source, loss, *conductances = (tensor.requires_grad_() for tensor in inputs())
    operator = Operator(tuple(conductances), loss)
    solve = SolverWithMemory(solve_by_multigrid, 1e-12, SolveMemory())
    u = solve_diffusion(solve, operator, source)
    assert operator.prepared

    def refuse(*_: object) -> None:
        raise AssertionError("prepared again")

    monkeypatch.setattr(hierarchy.Hierarchy, "of", refuse)
    solve_diffusion(solve, operator, 2 * source)
    torch.autograd.grad(u.sum(), loss)


def test_every_solve_is_recorded(inputs):
    memory = SolveMemory()
    source, *coefficients = inputs()
    u = solving(memory)(source.requires_grad_(), *coefficients)
    u.sum().backward()
    with forward_ad.dual_level():
        solving(memory)(forward_ad.make_dual(source.detach(), source.detach()), *coefficients)
    kinds = ["forward", "adjoint", "forward", "tangent"]
    assert [record.kind for record in memory.records] == kinds
    assert all(record.residual <= 1e-14 and record.seconds > 0 for record in memory.records)


@pytest.mark.parametrize("is_warm", [True, False])
def test_a_second_solve_starts_from_the_first(is_warm: bool, inputs):
    memory, arguments = SolveMemory(is_warm), inputs((4, 5, 3))
    solve = SolverWithMemory(solve_by_multigrid, 1e-10, memory)
    operator = Operator(tuple(arguments[2:]), arguments[1])
    first = solve("forward", operator, arguments[0])
    SolverWithMemory(solve.solver, 1e-9, memory)("forward", operator, arguments[0])
    assert memory.records[0].iterations > 0
    assert (memory.records[1].iterations == 0) == is_warm
    assert (memory.last.get(("forward", 0)) is not None) == is_warm
    assert first.shape == arguments[0].shape


@pytest.mark.parametrize("number", [0.0, 1e30, math.nan])
def test_what_a_caller_does_to_a_solution_changes_no_later_one(number: float, inputs):
    """A later solve begins from it only where that is nearer than zero."""
    memory, arguments = SolveMemory(), inputs()
    known = solving(memory)(*arguments).clone()
    memory.last["forward", 0].fill_(number)
    torch.testing.assert_close(solving(memory)(*arguments), known, rtol=1e-9, atol=0)
