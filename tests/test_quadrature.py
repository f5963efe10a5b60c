"""The sphere rule: exact for every monomial up to its degree, and as symmetric as the cube."""

from __future__ import annotations

import math

import pytest
import torch

from ddrecon.quadrature import sphere_quadrature

DIRECTIONS, WEIGHTS = sphere_quadrature(torch.zeros(1, dtype=torch.float64))
DEGREE = 11
MONOMIALS = [(a, b, c) for a in range(DEGREE + 1) for b in range(DEGREE + 1 - a) for c in range(DEGREE + 1 - a - b)]


def double_factorial(n: int) -> int:
    return math.prod(range(n, 0, -2))


def sphere_mean(powers: tuple[int, int, int]) -> float:
    """The mean of x^a y^b z^c over the unit sphere: 0 for an odd power, else (a-1)!! (b-1)!! (c-1)!! / (a+b+c+1)!!."""
    if any(power % 2 for power in powers):
        return 0.0
    return math.prod(double_factorial(power - 1) for power in powers) / double_factorial(sum(powers) + 1)


@pytest.mark.parametrize("degree", range(DEGREE + 1))
def test_monomials_are_exact(degree: int):
    for powers in (powers for powers in MONOMIALS if sum(powers) == degree):
        mean = WEIGHTS @ torch.stack([DIRECTIONS[:, axis] ** power for axis, power in enumerate(powers)]).prod(0)
        assert mean.item() == pytest.approx(sphere_mean(powers), abs=1e-15), powers


def test_directions_are_unit_and_weights_are_positive_and_sum_to_one():
    torch.testing.assert_close(DIRECTIONS.norm(dim=1), torch.ones_like(WEIGHTS), rtol=0, atol=1e-15)
    assert WEIGHTS.sum().item() == pytest.approx(1, abs=1e-15) and bool((WEIGHTS > 0).all())


@pytest.mark.parametrize("image", [-DIRECTIONS, DIRECTIONS.flip(1), DIRECTIONS.roll(1, 1), DIRECTIONS * torch.tensor([1.0, -1.0, 1.0])])
def test_every_symmetry_of_the_cube_maps_the_rule_onto_itself(image: torch.Tensor):
    is_same = (image[:, None] - DIRECTIONS).abs().amax(-1) < 1e-12
    assert bool((is_same.sum(1) == 1).all()) and bool((is_same.sum(0) == 1).all())
    assert torch.equal(WEIGHTS[is_same.to(torch.int8).argmax(1)], WEIGHTS)
