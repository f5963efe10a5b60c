"""Real spherical harmonics: orthonormal, rotation's invariants, and what short vectors fade to."""

import numpy as np
import pytest
import torch

from ddrecon.numerics.harmonics import harmonics
from ddrecon.numerics.quadrature import DEGREES, sphere_quadrature

degrees = pytest.mark.parametrize("degree", [0, 1, 3, 5, 7])


@degrees
@pytest.mark.parametrize("count", DEGREES)
def test_harmonics_are_orthonormal_where_a_rule_is_exact(degree: int, count: int):
    if 2 * degree > DEGREES[count]:
        degree = DEGREES[count] // 2
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), count)
    values = harmonics(points, degree)
    products = (values * weights) @ values.T
    torch.testing.assert_close(products, torch.eye(len(values), dtype=torch.float64))


@degrees
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sums_over_orders_are_legendre_polynomials_of_the_cosine(degree: int, dtype: torch.dtype):
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


def test_the_first_degree_is_the_vector_itself():
    z, y, x = 0.3, -0.5, 0.7
    first = harmonics(torch.tensor([z, y, x], dtype=torch.float64), 1)[1:]
    expected = torch.tensor([y, z, x], dtype=torch.float64) * 3**0.5
    torch.testing.assert_close(first, expected)


def test_harmonics_of_shorter_vectors_fade_by_their_degree():
    direction = torch.nn.functional.normalize(torch.tensor([0.2, 0.5, -0.4]).double(), dim=0)
    degrees = torch.tensor([ell for ell in range(6) for _ in range(2 * ell + 1)])
    fading = 0.3 ** degrees.double()
    torch.testing.assert_close(harmonics(0.3 * direction, 5), fading * harmonics(direction, 5))


def test_derivatives_are_finite_and_exact_also_at_the_poles_and_at_no_direction():
    for direction in ([1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.6, 0.0, 0.8]):
        point = torch.tensor(direction, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda v: harmonics(v, 4), point)
