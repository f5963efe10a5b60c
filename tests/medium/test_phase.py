"""The phase function and the scaling of its peak, checked by their moments over the sphere."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from media import box_grid, random_values

from ddrecon.medium.coefficients import Volume, keep_medium, scale_medium
from ddrecon.medium.phase import (
    forward_fraction,
    henyey_greenstein,
    peaked_phase,
    peaked_phase_along,
    scaled_mean_cosine,
)

MEAN_COSINES = (-0.8, -0.3, 0.0, 0.4, 0.8)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(100)


def scalar(value: float) -> torch.Tensor:
    return torch.tensor(value, dtype=torch.float64)


def legendre_moment(phase: torch.Tensor, degree: int) -> float:
    """The average of P_degree(cosine) over the sphere, weighted by a phase function given at the
    `NODES`.
    """
    polynomial = np.polynomial.legendre.Legendre.basis(degree)(NODES)
    return float((phase.numpy() * polynomial * WEIGHTS).sum() / 2)


@pytest.mark.parametrize("g", MEAN_COSINES)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_moments_are_powers_of_the_mean_cosine(g: float, degree: int):
    phase = henyey_greenstein(torch.tensor(NODES), scalar(g))
    assert legendre_moment(phase, degree) == pytest.approx(g**degree, abs=1e-12)


def peak_moment(g: float, depth: float, degree: int) -> float:
    """The moment of light that the forward peak alone has scattered, once at a given place on its
    way of `depth` scatterings.

    n of them fall on the way with Poisson's probability, each is the one in question with 1 / n,
    and n in a row have the moments of one to the power of n: 1 up to the second, g for the third.
    """
    counts = range(1, 80)
    chances = [math.exp(-depth) * depth ** (n - 1) / math.factorial(n) for n in counts]
    return g**2 * sum(
        chance * g ** (n * max(0, degree - 2)) for chance, n in zip(chances, counts, strict=True)
    )


@pytest.mark.parametrize("g", [0.05, 0.2, 0.4])
@pytest.mark.parametrize("depth", [1e-9, 0.3, 2.0, 9.0])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_peak_spreads_light_by_the_moments_of_its_scatterings(
    g: float, depth: float, degree: int
):
    phase = peaked_phase(scalar(depth), torch.tensor(NODES), scalar(g))
    rest = {0: 1 - g**2, 1: (1 - g**2) * g / (1 + g)}.get(degree, 0.0)
    assert legendre_moment(phase, degree) == pytest.approx(
        rest + peak_moment(g, depth, degree), rel=1e-9
    )


@pytest.mark.parametrize("g", [0.0, 1e-4, 0.3, 0.8, 0.95])
def test_a_peak_that_nothing_lies_behind_is_the_exact_phase_function(g: float):
    cosine = torch.linspace(-1, 1, 101, dtype=torch.float64)
    torch.testing.assert_close(
        peaked_phase(scalar(0.0), cosine, scalar(g)),
        henyey_greenstein(cosine, scalar(g)),
        rtol=1e-9,
        atol=1e-12,
    )


def test_a_spread_peak_is_finite_and_not_negative_at_any_depth():
    depth, cosine = torch.logspace(-30, 10, 61)[:, None].requires_grad_(), torch.linspace(-1, 1, 21)
    for g in (0.0, 0.5, 0.99):
        phase = peaked_phase(depth, cosine, torch.tensor(g))
        slope = torch.autograd.grad(phase.sum(), depth)[0]
        assert phase.isfinite().all() and (phase >= 0).all() and slope.isfinite().all()


def test_isotropic_scattering_is_one_everywhere():
    assert torch.equal(
        henyey_greenstein(torch.linspace(-1, 1, 7, dtype=torch.float64), scalar(0.0)),
        torch.ones(7, dtype=torch.float64),
    )


@pytest.mark.parametrize("g", [0.1, 0.5, 0.95])
def test_scaling_a_forward_peak_keeps_its_first_two_moments(g: float):
    f, rest = forward_fraction(scalar(g)), scaled_mean_cosine(scalar(g))
    assert (f + (1 - f) * rest).item() == pytest.approx(g, rel=1e-14)
    assert f.item() == pytest.approx(g**2, rel=1e-14)


@pytest.mark.parametrize("g", [-0.95, -0.2, 0.0])
def test_nothing_is_scaled_without_a_forward_peak(g: float):
    assert forward_fraction(scalar(g)) == 0 and scaled_mean_cosine(scalar(g)) == g


@pytest.mark.parametrize("function", [forward_fraction, scaled_mean_cosine])
def test_the_scaling_has_a_continuous_derivative_at_zero(function):
    slopes = torch.autograd.functional.jacobian(
        lambda g: function(g).sum(), torch.tensor([-1e-9, 1e-9], dtype=torch.float64)
    )
    assert slopes[0].item() == pytest.approx(slopes[1].item(), abs=1e-8)


@pytest.mark.parametrize("g", MEAN_COSINES)
def test_scaling_leaves_the_transport_extinction_alone(g: float):
    sigma_a, sigma_s = random_values(3, seed=1), random_values(3, seed=2)
    density = random_values(2, 3, 4)
    volume = Volume(box_grid((2, 3, 4)), density, sigma_a, sigma_s, scalar(g))
    exact = (sigma_a + (1 - g) * sigma_s).view(3, 1, 1, 1) * density
    for medium in (scale_medium(volume), keep_medium(volume)):
        torch.testing.assert_close(medium.transport_extinction, exact, rtol=1e-14, atol=0)
        by_parts = medium.absorption.value + (1 - medium.mean_cosine) * medium.remaining_scattering
        torch.testing.assert_close(by_parts, exact, rtol=1e-13, atol=0)
        torch.testing.assert_close(
            medium.extinction.value,
            medium.absorption.value + medium.remaining_scattering,
            rtol=1e-14,
            atol=0,
        )
    removed = keep_medium(volume).extinction.value - scale_medium(volume).extinction.value
    torch.testing.assert_close(
        removed, max(g, 0) ** 2 * sigma_s.view(3, 1, 1, 1) * density, rtol=1e-12, atol=1e-15
    )


@pytest.mark.parametrize("medium_of", [scale_medium, keep_medium])
def test_a_constant_cross_section_equals_the_same_one_in_every_cell(medium_of):
    sigma_a, sigma_s, density, grid = (
        random_values(3, seed=1),
        random_values(3, seed=2),
        random_values(2, 3, 4),
        box_grid((2, 3, 4)),
    )
    fields = [sigma.view(3, 1, 1, 1).expand(3, *grid.shape) for sigma in (sigma_a, sigma_s)]
    constant, varying = (
        medium_of(Volume(grid, density, *sigmas, scalar(0.3)))
        for sigmas in ((sigma_a, sigma_s), fields)
    )
    for name in ("extinction", "scattering", "absorption"):
        torch.testing.assert_close(
            getattr(constant, name).value, getattr(varying, name).value, rtol=1e-15, atol=0
        )


def test_a_density_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"\(2, 3, 5\).*\(2, 3, 4\)"):
        Volume(
            box_grid((2, 3, 4)),
            random_values(2, 3, 5),
            random_values(1),
            random_values(1),
            scalar(0.0),
        )


@pytest.mark.parametrize("g", [0.1, 0.5, 0.85, 0.95])
def test_along_rays_a_spread_peak_is_nearly_the_same(g: float):
    """And the same where nothing lies behind it."""
    cosine = torch.linspace(-1, 1, 41, dtype=torch.float64)
    depth = torch.cat([torch.zeros(1), torch.logspace(-4, 4, 400)]).double()[:, None]
    along, exact = (
        peaked_phase_along(depth[:, None].expand(-1, 1, 41), cosine, scalar(g))[:, 0],
        peaked_phase(depth, cosine, scalar(g)),
    )
    torch.testing.assert_close(along[0], exact[0], rtol=1e-9, atol=1e-12)
    assert float(((along - exact).abs() / exact.clamp(min=1)).max()) < 0.007


def test_along_rays_both_derivatives_agree_with_differences():
    depth = torch.rand(
        3, 2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    ).requires_grad_()
    cosine = torch.tensor([-0.9, -0.2, 0.4, 0.95], dtype=torch.float64).requires_grad_()
    arguments = (depth, cosine, scalar(0.6).requires_grad_())
    assert torch.autograd.gradcheck(peaked_phase_along, arguments, check_forward_ad=True)
