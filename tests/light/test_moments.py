"""Light to first order in angle, held at zero."""

import pytest
import torch
from torch import Tensor

from ddrecon.light.moments import MARGIN, Moments

DTYPES = [torch.float32, torch.float64]


def along_z(mean: Tensor, flux: Tensor) -> Tensor:
    """What `mean` and `flux` along z send along z."""
    nothing = torch.zeros_like(flux)
    one = torch.ones((), dtype=mean.dtype)
    return Moments(mean, (flux, nothing, nothing)).positive_along((one, one, one))


def fluxes(*values: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(values, dtype=dtype).view(1, 1, 1, -1)


def test_radiance_above_its_margin_is_left_as_it_is():
    flux = fluxes(-0.97, -0.5, 0.0, 0.5, 3.0)
    assert torch.equal(along_z(torch.ones_like(flux), flux), 1 + flux)


def test_radiance_far_below_zero_is_zero():
    assert not along_z(fluxes(1.0, -1.0, -1.0), fluxes(-1.1, -1.0, 0.9)).any()


def test_without_a_flux_only_what_is_below_zero_is_changed():
    """At zero itself, as in empty space, derivatives pass."""
    mean = fluxes(-1.0, 0.0, 2.0).requires_grad_()
    held = Moments(mean).positive_along((torch.ones(()),) * 3)
    assert held.flatten().tolist() == [0.0, 0.0, 2.0]
    assert torch.autograd.grad(held.sum(), mean)[0].flatten().tolist() == [0.0, 1.0, 1.0]


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_radiance_rises_from_zero_without_a_jump_in_value_or_slope(dtype: torch.dtype):
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
def test_values_and_slopes_are_finite_whatever_the_unit(scale: float, dtype: torch.dtype):
    flux = (scale * fluxes(-2.0, -1.0, -0.985, 0.0, 5.0, dtype=dtype)).requires_grad_()
    mean = torch.full_like(flux, scale).detach().requires_grad_()
    radiance = along_z(mean, flux)
    slopes = torch.autograd.grad(radiance.sum(), (mean, flux))
    assert bool((radiance >= 0).all())
    assert all(bool(slope.isfinite().all()) for slope in (radiance, *slopes))


def test_the_light_switched_on_from_nothing_counts_in_full():
    """No light at all is no kink: reconstructions of a light start there."""
    nothing = torch.zeros(1, 1, 1, 1, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(along_z(nothing, nothing.detach()).sum(), nothing)
    assert float(slope) == 1


def test_both_modes_agree_with_differences_within_the_bend():
    flux = fluxes(-0.985, -0.995, -1.0, -1.01).requires_grad_()
    mean = torch.ones_like(flux).detach().requires_grad_()
    how = {"eps": 1e-7, "atol": 1e-5, "check_forward_ad": True}
    assert torch.autograd.gradcheck(along_z, (mean, flux), **how)


def test_higher_moments_of_one_color_are_those_of_all():
    """As of a white beam in colored ambient light."""
    color = torch.ones(3, 1, 2, 1)
    light = Moments(color, (color,) * 3, torch.ones(12, 1, 1, 2, 1))
    assert light.harmonics(3)[4:].equal(torch.ones(12, 3, 1, 2, 1))


def test_a_part_of_the_way_to_other_light_is_linear_in_that_part():
    """By all moments; higher ones that light lacks are zero."""
    fields = torch.arange(72, dtype=torch.float64).view(2, 9, 1, 1, 2, 2).sin()
    one, other = (Moments.of_harmonics(each) for each in fields)
    part = torch.tensor(1.7, dtype=torch.float64, requires_grad=True)
    for start in (one, Moments(one.mean, one.flux)):
        begin = start.harmonics(2)
        way = other.harmonics(2) - begin
        found = start.toward(other, part).harmonics(2)
        torch.testing.assert_close(found, begin + 1.7 * way, rtol=1e-14, atol=1e-14)
        (slope,) = torch.autograd.grad(found.sum(), part)
        torch.testing.assert_close(slope, way.sum(), rtol=1e-13, atol=1e-13)
