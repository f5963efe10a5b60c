"""Flux limiters in dense media and in empty space; between, they are smooth."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from ddrecon.diffusion.limiters import LIMITERS, SERIES_BELOW, levermore_pomraning

each_limiter = pytest.mark.parametrize("limiter", LIMITERS.values(), ids=LIMITERS.keys())
STREAMING = {"marshak": 0.5, "levermore_pomraning": 1.0}
"""The flux in units of L0 where nothing collides."""


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


@each_limiter
def test_even_light_diffuses_with_one_third_of_the_transport_length(limiter):
    assert float(limiter(number(7.0), number(0.0))) == pytest.approx(1 / 21, rel=1e-15)
    assert float(limiter(number(7.0), number(1e-6))) == pytest.approx(1 / 21, rel=1e-7)


@pytest.mark.parametrize("name", LIMITERS)
def test_light_in_empty_space_flows_no_faster_than_it_may(name: str):
    steepness = 5.0
    flux = steepness * float(LIMITERS[name](number(1e-9), number(steepness**2)))
    assert flux == pytest.approx(STREAMING[name], rel=1e-6)


@each_limiter
def test_flux_never_exceeds_radiance(limiter):
    extinction, steepness = (
        torch.logspace(-6, 6, 61, dtype=torch.float64),
        torch.logspace(-6, 6, 49, dtype=torch.float64)[:, None],
    )
    assert bool((steepness * limiter(extinction, steepness**2) < 1).all())


@each_limiter
@pytest.mark.parametrize("square", [0.0, 1e-8, SERIES_BELOW, 1.0, 1e6])
def test_derivatives(limiter, square: float):
    arguments = (number(0.7).requires_grad_(), number(0.49 * square + 1e-3).requires_grad_())
    assert torch.autograd.gradcheck(limiter, arguments, eps=1e-7, atol=1e-8, check_forward_ad=True)
    slopes = torch.autograd.grad(limiter(arguments[0], arguments[1] * 0), arguments)
    assert all(bool(slope.isfinite()) for slope in slopes)


def test_the_series_meets_the_closed_form():
    below, above = (
        levermore_pomraning(number(1.0), number(SERIES_BELOW * factor))
        for factor in (1 - 1e-12, 1 + 1e-12)
    )
    assert float((below - above).abs()) < 1e-12
