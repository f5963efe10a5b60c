"""Light to first order in angle, held at zero."""

import pytest
import torch

from ddrecon.light.moments import (
    MARGIN,
    add,
    beam_moments,
    fill,
    flux_along_axes,
    moments_of_flux,
    radiance_along,
    weigh,
)
from ddrecon.numerics.sphere import harmonics, sphere_quadrature

DTYPES = [torch.float32, torch.float64]


def along_z(mean, flux):
    """What `mean` and `flux` along z send along z."""
    nothing = torch.zeros_like(flux)
    one = torch.ones((), dtype=mean.dtype)
    phi = torch.cat([mean[None], moments_of_flux((flux, nothing, nothing))])
    return radiance_along(phi, (one, one * 0, one * 0))


def fluxes(*values, dtype=torch.float64):
    return torch.tensor(values, dtype=dtype).view(1, 1, 1, -1)


def test_radiance_above_its_margin_is_left_as_it_is():
    flux = fluxes(-0.97, -0.5, 0.0, 0.5, 3.0)
    torch.testing.assert_close(along_z(torch.ones_like(flux), flux), 1 + flux, rtol=1e-14, atol=0)


def test_radiance_far_below_zero_is_zero():
    assert not along_z(fluxes(1.0, -1.0, -1.0), fluxes(-1.1, -1.0, 0.9)).any()


def test_without_a_flux_only_what_is_below_zero_is_changed():
    """At zero itself, as in empty space, derivatives pass."""
    mean = fluxes(-1.0, 0.0, 2.0).requires_grad_()
    held = radiance_along(mean[None], (torch.ones(()),) * 3)
    assert held.flatten().tolist() == [0.0, 0.0, 2.0]
    assert torch.autograd.grad(held.sum(), mean)[0].flatten().tolist() == [0.0, 1.0, 1.0]


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_radiance_rises_from_zero_without_a_jump_in_value_or_slope(dtype):
    """Towards both ends of the bend, r = m and r = -m with m = MARGIN (1 + |flux|), mean 1."""
    ends = [-(1 - MARGIN) / (1 + MARGIN), -(1 + MARGIN) / (1 - MARGIN)]
    step = 1e-4
    places = [end + side * step for end in ends for side in (-1, 1)]
    flux = fluxes(*places, dtype=dtype).requires_grad_()
    radiance = along_z(torch.ones_like(flux), flux)
    (slope,) = torch.autograd.grad(radiance.sum(), flux)
    inner, outer, dark, dim = radiance.detach().flatten().tolist()
    assert outer - inner == pytest.approx(2 * step, rel=0.02) and 0 == dark <= dim < step
    for below, above in slope.flatten().view(2, 2).tolist():
        assert below == pytest.approx(above, abs=0.02)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("scale", [0.0, 1e-37, 1e-20, 1e20])
def test_values_and_slopes_are_finite_whatever_the_unit(scale, dtype):
    flux = (scale * fluxes(-2.0, -1.0, -0.985, 0.0, 5.0, dtype=dtype)).requires_grad_()
    mean = torch.full_like(flux, scale).detach().requires_grad_()
    radiance = along_z(mean, flux)
    slopes = torch.autograd.grad(radiance.sum(), (mean, flux))
    assert bool((radiance >= 0).all())
    assert all(bool(slope.isfinite().all()) for slope in (radiance, *slopes))


def test_both_modes_agree_with_differences_within_the_bend():
    flux = fluxes(-0.985, -0.995, -1.0, -1.01).requires_grad_()
    mean = torch.ones_like(flux).detach().requires_grad_()
    how = {"eps": 1e-7, "atol": 1e-5, "check_forward_ad": True}
    assert torch.autograd.gradcheck(along_z, (mean, flux), **how)


def test_moments_are_the_integrals_over_the_sphere():
    """phi_k is the mean of Y_k L, and L1 three times that of L times its direction."""
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), 50)
    radiance = torch.exp(points @ points.new_tensor([0.3, -0.2, 0.5]))
    phi = (harmonics(points, 3) * weights * radiance).sum(1).view(-1, 1, 1, 1, 1)
    flux = 3 * (weights * radiance) @ points
    assert phi[0].item() == pytest.approx(float(weights @ radiance), rel=1e-13)
    found = torch.stack(flux_along_axes(phi[1:4]))
    torch.testing.assert_close(found.flatten(), flux, rtol=1e-13, atol=0)
    torch.testing.assert_close(moments_of_flux(found), phi[1:4], rtol=1e-13, atol=0)


def test_light_of_a_beam_is_sharpest_along_it():
    """Of degree L it is (L + 1)^2 times its mean there, by the addition theorem."""
    way = torch.tensor([0.48, -0.6, 0.64], dtype=torch.float64)
    mean = fluxes(0.7, 1.3)
    for degree in (0, 1, 3, 5):
        phi = beam_moments(mean, way, degree)
        cells = beam_moments(mean, way.expand(1, 1, 2, 3), degree)
        torch.testing.assert_close(cells, phi, rtol=1e-14, atol=1e-15)
        along = radiance_along(phi, way.view(3, 1, 1, 1).unbind())
        torch.testing.assert_close(along, (degree + 1) ** 2 * mean, rtol=1e-13, atol=0)


def test_sums_and_weights_are_those_of_radiance():
    """Of light that is known to different degrees and in different colors, along any direction."""
    fields = torch.arange(72, dtype=torch.float64).view(2, 9, 1, 1, 2, 2).sin()
    few, many = fields[0, :4] + fields.new_tensor([2.0, 3.0]).view(2, 1, 1, 1), 9 + fields[1]
    total = add(few, many)
    assert total.shape == (9, 2, 1, 2, 2)
    assert total.equal(fill(few, 2) + many) and total.equal(add(many, few))
    factors = torch.tensor([1.0, 0.5, 0.2], dtype=torch.float64).view(3, 1, 1, 1, 1)
    assert weigh(many, factors)[[0, 2, 7]].equal(many[[0, 2, 7]] * factors)
    assert weigh(few, factors).equal(fill(few, 2)[:4] * factors[[0, 1, 1, 1]])
