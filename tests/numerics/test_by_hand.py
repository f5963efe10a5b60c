"""Derivatives written by hand are those of autograd through the plain formula, in both modes."""

from __future__ import annotations

import pytest
import torch
from media import random_values
from plain_formulas import RULES, Function, Rule, depths
from torch import Tensor

EDGES = {
    "decayed_sum, all by color": ("decayed_sum", [(6, 3, 4)] * 3, (3, 1)),
    "decayed_sum, weight by color": ("decayed_sum", [(6, 3, 4), (6, 1, 4), (6, 1, 4)], (3, 1)),
    "decayed_sum, depth by color": ("decayed_sum", [(6, 1, 4), (6, 3, 4), (6, 3, 4)], (3, 1)),
    "decayed_line, near gray": ("decayed_line", [(5, 1, 2), (5, 3, 2)], (5, 3, 2)),
    "decayed_line, far gray": ("decayed_line", [(5, 3, 2), (5, 1, 2)], (5, 3, 2)),
    "follow, medium gray": ("follow", [(4, 1, 3, 5)], (4, 3, 3, 5)),
}
"""Where inputs lack the color that others have: rule, shapes, and the last input's, of depths."""


def case(name: str) -> tuple[Rule, tuple[Tensor, ...]]:
    if name in EDGES:
        rule, shapes, last = EDGES[name]
        inputs = [random_values(*shape, seed=seed) for seed, shape in enumerate(shapes)]
        return RULES[rule], (*inputs, depths(*last, seed=len(inputs)))
    rule, _, size = name.partition(", ")
    shape = (1, 1, 2, 2) if size else (5, 3, 4, 3)
    return RULES[rule], RULES[rule].inputs(shape, torch.float64)


each_case = pytest.mark.parametrize(
    "name", [*RULES, *(f"{name}, one slice" for name in RULES), *EDGES]
)


def parts(result: Tensor | tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return result if isinstance(result, tuple) else (result,)


def pulled_back(
    function: Function, inputs: tuple[Tensor, ...], varied: list[int]
) -> tuple[Tensor, ...]:
    """The derivatives by the inputs `varied` of a weighted sum of all results."""
    leaves = [x.clone().requires_grad_(i in varied) for i, x in enumerate(inputs)]
    results = parts(function(*leaves))
    weights = [random_values(*result.shape, seed=50 + i) for i, result in enumerate(results)]
    total = sum((one * weight).sum() for one, weight in zip(results, weights, strict=True))
    return torch.autograd.grad(total, [leaves[i] for i in varied], materialize_grads=True)


def pushed_forward(
    function: Function, inputs: tuple[Tensor, ...], varied: list[int]
) -> tuple[Tensor, ...]:
    """How all results change with the inputs `varied`."""

    def of_varied(*values: Tensor) -> tuple[Tensor, ...]:
        changed = dict(zip(varied, values, strict=True))
        return parts(function(*(changed.get(i, x) for i, x in enumerate(inputs))))

    primals = tuple(inputs[i] for i in varied)
    changes = tuple(random_values(*x.shape, seed=70 + i) - 0.5 for i, x in enumerate(primals))
    return torch.func.jvp(of_varied, primals, changes)[1]


def assert_same(found: tuple[Tensor, ...], wanted: tuple[Tensor, ...]) -> None:
    for one, other in zip(found, wanted, strict=True):
        scale = float(other.abs().max())
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11 * scale)


@each_case
def test_values_are_those_of_the_plain_formula(name: str) -> None:
    rule, inputs = case(name)
    assert_same(parts(rule.by_hand(*inputs)), parts(rule.plain(*inputs)))


@each_case
@pytest.mark.parametrize("derivative", [pulled_back, pushed_forward], ids=["reverse", "forward"])
def test_derivatives_are_those_of_the_plain_formula(name: str, derivative) -> None:
    """By all inputs together, and by each alone: what is not varied is skipped."""
    rule, inputs = case(name)
    everything = list(range(len(inputs)))
    for varied in [everything, *([i] for i in everything)]:
        assert_same(
            derivative(rule.by_hand, inputs, varied), derivative(rule.plain, inputs, varied)
        )
