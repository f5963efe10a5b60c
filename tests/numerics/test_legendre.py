"""Legendre polynomials, their sums and Gauss's rule; tables over the angle."""

import math

import numpy as np
import torch

from ddrecon.numerics.series import (
    STEPS,
    angle_of,
    even_angles,
    gauss_legendre,
    legendre,
    legendre_at_even_angles,
    look_up,
    with_slopes,
)


def test_a_long_rule_is_exact_to_twice_its_length():
    cosine, weights = gauss_legendre(2048)
    rows = legendre(cosine, 1024)
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
    found = look_up(table, even_angles(4))
    torch.testing.assert_close(found, table[:, :, 0])
    angles = torch.tensor([0.1, 1.4, 3.0], dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(look_up, (table, angles), check_forward_ad=True)


def test_angles_have_a_derivative_everywhere():
    cosine = torch.tensor([-1.0, -0.3, 1.0]).requires_grad_()
    values = torch.exp(2 * even_angles(STEPS).cos())[None]
    (slope,) = torch.autograd.grad(look_up(with_slopes(values), angle_of(cosine)).sum(), cosine)
    expected = 2 * torch.exp(2 * cosine.detach())
    assert slope.isfinite().all()
    torch.testing.assert_close(slope[1], expected[1], rtol=1e-5, atol=0)
