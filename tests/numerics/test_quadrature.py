"""The sphere rule: exact for every monomial up to its degree, and as symmetric as the cube."""

import math
from collections.abc import Callable
from itertools import product

import pytest
import torch
from torch import Tensor

from ddrecon.numerics.quadrature import DEGREES, layer_quadrature, sphere_quadrature

RULES = {count: sphere_quadrature(torch.zeros(1, dtype=torch.float64), count) for count in DEGREES}
each_rule = pytest.mark.parametrize("count", RULES)


def double_factorial(n: int) -> int:
    return math.prod(range(n, 0, -2))


def sphere_mean(powers: tuple[int, int, int]) -> float:
    """x^a y^b z^c over the sphere: (a-1)!! (b-1)!! (c-1)!! / (a+b+c+1)!!, or 0 for an odd power."""
    if any(power % 2 for power in powers):
        return 0.0
    above = math.prod(double_factorial(power - 1) for power in powers)
    return above / double_factorial(sum(powers) + 1)


def error(count: int, powers: tuple[int, int, int]) -> float:
    directions, weights = RULES[count]
    mean = weights @ (directions ** torch.tensor(powers)).prod(1)
    return abs(float(mean) - sphere_mean(powers))


@each_rule
def test_monomials_are_exact_up_to_the_degree_of_the_rule_and_no_further(count: int):
    top = DEGREES[count] + 1
    monomials = [each for each in product(range(top + 1), repeat=3) if sum(each) <= top]
    assert max(error(count, powers) for powers in monomials if sum(powers) < top) < 1e-15
    assert max(error(count, powers) for powers in monomials if sum(powers) == top) > 1e-5


def test_the_flux_through_a_face_is_exact_with_44_directions():
    """As half the sphere has it: the mean of |x| is 1/2."""
    directions, weights = RULES[44]
    flux = weights @ directions.abs()
    torch.testing.assert_close(flux, torch.full_like(flux, 0.5), rtol=1e-14, atol=0)


@each_rule
def test_directions_are_unit_and_weights_are_positive_and_sum_to_one(count: int):
    directions, weights = RULES[count]
    assert directions.shape == (count, 3)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones_like(weights), rtol=0, atol=1e-15)
    assert weights.sum().item() == pytest.approx(1, abs=1e-15) and bool((weights > 0).all())


IMAGES = {
    "point": lambda points: -points,
    "diagonal": lambda points: points.flip(1),
    "turn": lambda points: points.roll(1, 1),
    "plane": lambda points: points * torch.tensor([1.0, -1.0, 1.0]),
}


@each_rule
@pytest.mark.parametrize("image", IMAGES.values(), ids=IMAGES.keys())
def test_every_symmetry_of_the_cube_maps_the_rule_onto_itself(
    count: int, image: Callable[[Tensor], Tensor]
):
    directions, weights = RULES[count]
    is_same = (image(directions)[:, None] - directions).abs().amax(-1) < 1e-12
    assert bool((is_same.sum(1) == 1).all()) and bool((is_same.sum(0) == 1).all())
    assert torch.equal(weights[is_same.to(torch.int8).argmax(1)], weights)


@pytest.mark.parametrize(("levels", "azimuths"), [(3, 8), (4, 12)])
@pytest.mark.parametrize("normal", range(3))
def test_layers_are_exact_on_either_side(normal: int, levels: int, azimuths: int):
    """Half the sphere has the mean 1/(2 l + 2) of mu^l, and none of (x + i y)^m."""
    like = torch.zeros(1, dtype=torch.float64)
    directions, weights = layer_quadrature(like, normal, levels, azimuths)
    first, second = (directions[:, axis] for axis in range(3) if axis != normal)
    around = torch.complex(first, second)
    for side, power in product((1, -1), range(2 * levels + 1)):
        cosine = side * directions[:, normal]
        flux = weights * torch.where(cosine > 0, cosine**power, 0)
        assert float(flux.sum()) == pytest.approx(1 / (2 * power + 2), abs=1e-14)
        waves = (complex((flux * around**m).sum()) for m in range(1, azimuths))
        assert max(map(abs, waves)) < 1e-14
    assert len(weights) == 2 * (levels * azimuths + 1)
    assert weights.sum().item() == pytest.approx(1, abs=1e-14) and bool((weights > 0).all())
    torch.testing.assert_close(directions.norm(dim=1), torch.ones_like(weights), rtol=0, atol=1e-15)
