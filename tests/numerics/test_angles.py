"""Functions of directions: harmonics, Legendre series, tables and rules over the sphere."""

import math
from itertools import product

import numpy as np
import pytest
import torch

from ddrecon.numerics.series import (
    STEPS,
    angle_of,
    even_angles,
    fejer,
    legendre,
    legendre_at_even_angles,
    look_up,
    with_slopes,
)
from ddrecon.numerics.sphere import harmonics, sphere_quadrature

DEGREES = {18: 5, 26: 7, 44: 7, 50: 11, 96: 7}
"""The degree up to which the rule of so many points is exact."""
degrees = pytest.mark.parametrize("degree", [0, 1, 3, 5, 7])


@degrees
@pytest.mark.parametrize("count", DEGREES)
def test_harmonics_are_orthonormal_where_a_rule_is_exact(degree, count):
    if 2 * degree > DEGREES[count]:
        degree = DEGREES[count] // 2
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), count)
    values = harmonics(points, degree)
    products = (values * weights) @ values.T
    torch.testing.assert_close(products, torch.eye(len(values), dtype=torch.float64))


@degrees
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sums_over_orders_are_legendre_polynomials_of_the_cosine(degree, dtype):
    generator = torch.Generator().manual_seed(1)
    a, b = (
        torch.nn.functional.normalize(torch.randn(20, 3, generator=generator, dtype=dtype), dim=-1)
        for _ in range(2)
    )
    products = harmonics(a, degree) * harmonics(b, degree)
    cosine = (a * b).sum(-1).double().numpy()
    for ell in range(degree + 1):
        legendre = np.polynomial.legendre.legval(cosine, [0] * ell + [1])
        total = products[ell * ell : (ell + 1) ** 2].sum(0)
        expected = torch.from_numpy((2 * ell + 1) * legendre).to(dtype)
        tolerance = 1e-12 if dtype == torch.float64 else 1e-5
        torch.testing.assert_close(total, expected, rtol=0, atol=tolerance * (2 * ell + 1))


def test_harmonics_of_shorter_vectors_fade_by_their_degree():
    direction = torch.nn.functional.normalize(torch.tensor([0.2, 0.5, -0.4]).double(), dim=0)
    degrees = torch.tensor([ell for ell in range(6) for _ in range(2 * ell + 1)])
    fading = 0.3 ** degrees.double()
    torch.testing.assert_close(harmonics(0.3 * direction, 5), fading * harmonics(direction, 5))


def test_a_long_rule_is_exact_to_its_length():
    angle, weights = fejer(2048)
    rows = legendre(angle.cos(), 1024)
    products = (rows * weights[:, None]).T @ rows
    expected = torch.diag(2 / (2 * torch.arange(1024).double() + 1))
    torch.testing.assert_close(products, expected, rtol=0, atol=1e-13)


def test_polynomials_are_numpy_s_and_slopes_are_differences():
    rows, slopes = legendre_at_even_angles(64, 9)
    angle = even_angles(64)
    known = np.polynomial.legendre.legvander(angle.cos().numpy(), 8)
    np.testing.assert_allclose(rows, known, rtol=0, atol=1e-13)
    ahead, behind = (legendre((angle + step).cos(), 9) for step in (1e-6, -1e-6))
    torch.testing.assert_close(slopes, (ahead - behind) / 2e-6, rtol=0, atol=1e-8)


def test_a_table_is_of_fourth_order_and_smooth():
    """And so are its differences, where slopes are not known."""
    angles = torch.linspace(0, math.pi, 997, dtype=torch.float64)
    exact, errors = torch.exp(2 * angles.cos()), []
    for steps in (32, 64):
        values = torch.exp(2 * even_angles(steps).cos())[None]
        errors.append(float((look_up(with_slopes(values), angles)[0, :, 0] - exact).abs().max()))
    assert errors[0] / errors[1] > 13 and errors[1] < 1e-4


def test_a_table_meets_its_values_and_has_both_derivatives():
    table = torch.rand(2, 5, 2, 3, dtype=torch.float64).requires_grad_()
    actual = look_up(table, even_angles(4))
    torch.testing.assert_close(actual, table[:, :, 0])
    angles = torch.tensor([0.1, 1.4, 3.0], dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(look_up, (table, angles), check_forward_ad=True)


def test_angles_have_a_derivative_everywhere():
    cosine = torch.tensor([-1.0, -0.3, 1.0]).requires_grad_()
    values = torch.exp(2 * even_angles(STEPS).cos())[None]
    (slope,) = torch.autograd.grad(look_up(with_slopes(values), angle_of(cosine)).sum(), cosine)
    expected = 2 * torch.exp(2 * cosine.detach())
    assert slope.isfinite().all()
    torch.testing.assert_close(slope[1], expected[1], rtol=1e-5, atol=0)


RULES = {count: sphere_quadrature(torch.zeros(1, dtype=torch.float64), count) for count in DEGREES}
each_rule = pytest.mark.parametrize("count", RULES)


def double_factorial(n):
    return math.prod(range(n, 0, -2))


def sphere_mean(powers):
    """x^a y^b z^c over the sphere: (a-1)!! (b-1)!! (c-1)!! / (a+b+c+1)!!, or 0 for an odd power."""
    if any(power % 2 for power in powers):
        return 0.0
    above = math.prod(double_factorial(power - 1) for power in powers)
    return above / double_factorial(sum(powers) + 1)


def error(count, powers):
    directions, weights = RULES[count]
    mean = weights @ (directions ** torch.tensor(powers)).prod(1)
    return abs(float(mean) - sphere_mean(powers))


@each_rule
def test_monomials_are_exact_up_to_the_degree_of_the_rule_and_no_further(count):
    top = DEGREES[count] + 1
    monomials = [each for each in product(range(top + 1), repeat=3) if sum(each) <= top]
    assert max(error(count, powers) for powers in monomials if sum(powers) < top) < 1e-15
    assert max(error(count, powers) for powers in monomials if sum(powers) == top) > 1e-5


FLUX = 1, 0, 0


@pytest.mark.parametrize(
    ("count", "powers"), [(44, [FLUX]), (96, [FLUX, (1, 1, 0), (3, 0, 0), (5, 0, 0)])]
)
def test_light_at_a_face_is_integrated_from_each_side(count, powers):
    """Means of |x^a y^b|: the flux through a face, and more where light is peaked."""
    directions, weights = RULES[count]
    for exponents in powers:
        mean = float(weights @ (directions.abs() ** torch.tensor(exponents)).prod(1))
        gammas = math.prod(math.gamma((power + 1) / 2) for power in exponents)
        exact = gammas / (2 * math.pi * math.gamma((sum(exponents) + 3) / 2))
        assert mean == pytest.approx(exact, rel=1e-14)
    assert count == 44 or directions.abs().min() > 0.05  # none lies within a face
