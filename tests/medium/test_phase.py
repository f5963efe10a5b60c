"""Phase functions and the scaling of their peak, checked by their moments over the sphere."""

import math

import numpy as np
import pytest
import torch
from media import box_grid, random_values, summed_series, tensor
from torch import Tensor

from ddrecon.medium.coefficients import Volume, keep_medium, scale_medium
from ddrecon.medium.phase import (
    Blend,
    HenyeyGreenstein,
    PhaseFunction,
    Rayleigh,
    Tabulated,
    TwoLobe,
)
from ddrecon.medium.phase_peak import SeenPhase
from ddrecon.numerics.series import STEPS, even_angles

MEAN_COSINES = (-0.8, -0.3, 0.0, 0.4, 0.8)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(100)


def scalar(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def bump() -> Tensor:
    """A smooth table with a wide peak, not normalized."""
    return 3 * torch.exp(2 * even_angles(STEPS).cos())[None]


PHASES: dict[str, PhaseFunction] = {
    "forward": HenyeyGreenstein(scalar(0.7)),
    "backward": HenyeyGreenstein(scalar(-0.4)),
    "by color": HenyeyGreenstein(tensor(0.7, 0.0, -0.3)),
    "two lobes": TwoLobe(tensor(0.7, -0.5), scalar(0.6)),
    "two lobes by color": TwoLobe(tensor(0.7, 0.2), tensor(0.2, 0.6, 1.0)),
    "rayleigh": Rayleigh(scalar(0.0)),
    "blend": Blend(HenyeyGreenstein(tensor(0.7, 0.5, -0.6)), Rayleigh(scalar(0.0)), scalar(0.3)),
    "table": Tabulated(bump()),
}
each_phase = pytest.mark.parametrize("phase", PHASES.values(), ids=PHASES.keys())
each_degree = pytest.mark.parametrize("degree", [1, 3])


def legendre_moments(values: Tensor, count: int) -> Tensor:
    """The averages [C, count] of P_l over the sphere, weighted by values [C, n] at NODES."""
    rows = np.polynomial.legendre.legvander(NODES, count - 1) * WEIGHTS[:, None] / 2
    return values @ torch.from_numpy(rows)


@each_phase
def test_moments_are_those_of_the_values(phase: PhaseFunction):
    found = legendre_moments(phase.value(torch.tensor(NODES)), 12)
    torch.testing.assert_close(found, phase.moments(12), rtol=0, atol=1e-7)
    assert len(found) == phase.colors
    assert torch.equal(phase.moments(1), torch.ones_like(phase.moments(1)))


LOBES = TwoLobe(tensor(0.6, -0.3), scalar(0.4))


@pytest.mark.parametrize(
    "one, other",
    [
        (TwoLobe(tensor(0.6, -0.9), scalar(1.0)), HenyeyGreenstein(scalar(0.6))),
        (TwoLobe(tensor(0.6, -0.9), scalar(0.0)), HenyeyGreenstein(scalar(-0.9))),
        (Blend(*LOBES.parts, scalar(0.4)), LOBES),
        (Tabulated(1 + even_angles(STEPS).cos()[None] ** 2), Rayleigh(scalar(0.0))),
    ],
)
def test_special_cases_are_each_other(one: PhaseFunction, other: PhaseFunction):
    cosine = torch.linspace(-1, 1, 37, dtype=torch.float64)
    torch.testing.assert_close(one.value(cosine), other.value(cosine), rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(one.moments(30), other.moments(30), rtol=0, atol=1e-10)
    for degree in (1, 3):
        tails = (phase.peak_tail(degree, 1) for phase in (one, other))
        torch.testing.assert_close(*tails, rtol=0, atol=1e-10)


@pytest.mark.parametrize("phase", [*PHASES.values()][:-1], ids=[*PHASES][:-1])
def test_values_and_moments_have_both_derivatives(phase: PhaseFunction):
    kind, cosine = phase.kind, tensor(-0.95, 0.2, 0.9).requires_grad_()
    numbers = [number.clone().requires_grad_() for number in phase.numbers]

    def found(cosine: Tensor, *numbers: Tensor) -> tuple[Tensor, ...]:
        phase = kind(*numbers)
        return (
            phase.value(cosine),
            phase.moments(5),
            phase.peak_tail(1, 4),
            phase.peak_tail(3, 4, -1),
        )

    assert torch.autograd.gradcheck(found, (cosine, *numbers), check_forward_ad=True)


# --- what a forward peak does to a beam ----------------------------------------------------------


def peak_moment(g: float, depth: float, degree: int, kept: int) -> float:
    """The moment of light that the forward peak alone has scattered, on a way of `depth`.

    n scatterings fall on it with Poisson's probability, each is the one in question with 1 / n,
    and n in a row have the moments of one to the power of n: 1 up to `kept`, then g, g^2, ...
    """
    counts = range(1, 80)
    chances = [math.exp(-depth) * depth ** (n - 1) / math.factorial(n) for n in counts]
    return g ** (kept + 1) * sum(
        chance * g ** (n * max(0, degree - kept - 1))
        for chance, n in zip(chances, counts, strict=True)
    )


@pytest.mark.parametrize("g", [0.05, 0.2, 0.4])
@pytest.mark.parametrize("depth", [1e-9, 0.3, 2.0, 9.0])
@each_degree
def test_a_peak_spreads_light_by_the_moments_of_its_scatterings(
    g: float, depth: float, degree: int
):
    seen = SeenPhase(HenyeyGreenstein(scalar(g)), degree)
    found = legendre_moments(summed_series(seen, tensor(depth)[None], torch.tensor(NODES)), 8)[0]
    for moment in range(8):
        rest = g**moment - g ** (degree + 1) if moment <= degree else 0.0
        expected = rest + peak_moment(g, depth, moment, degree)
        assert float(found[moment]) == pytest.approx(expected, rel=1e-7)


@each_phase
@each_degree
def test_a_peak_that_nothing_lies_behind_is_the_exact_phase_function(
    phase: PhaseFunction, degree: int
):
    cosine = torch.linspace(-1, 1, 101, dtype=torch.float64)
    seen, exact = SeenPhase(phase, degree), phase.value(cosine)
    summed = summed_series(seen, tensor(0.0)[None], cosine)
    torch.testing.assert_close(summed, exact, rtol=1e-6, atol=1e-6)
    along = seen.along(torch.zeros(1, len(exact), 101, dtype=torch.float64), cosine)
    torch.testing.assert_close(along[0], exact, rtol=1e-6, atol=1e-6)


@each_phase
def test_a_spread_peak_is_finite_and_not_negative_at_any_depth(phase: PhaseFunction):
    depth = torch.logspace(-30, 10, 21).view(-1, 1, 1).requires_grad_()
    cosine = torch.linspace(-1, 1, 21).requires_grad_()
    found = SeenPhase(phase, 3).along(depth.expand(-1, phase.colors, 21), cosine)
    bars = torch.autograd.grad(found.sum(), (depth, cosine))
    assert (found >= 0).all()
    assert all(bool(each.isfinite().all()) for each in (found, *bars))


@pytest.mark.parametrize("g", [0.1, 0.5, 0.85, 0.95])
@each_degree
def test_along_rays_a_spread_peak_is_nearly_the_same(g: float, degree: int):
    """And the same where nothing lies behind it."""
    cosine = torch.linspace(-1, 1, 41, dtype=torch.float64)
    depth = torch.cat([torch.zeros(1), torch.logspace(-4, 4, 400)]).double().view(-1, 1, 1)
    seen = SeenPhase(HenyeyGreenstein(scalar(g)), degree)
    along = seen.along(depth.expand(-1, 1, 41), cosine)[:, 0]
    exact = summed_series(seen, depth.movedim(1, 0), cosine)[0]
    torch.testing.assert_close(along[0], exact[0], rtol=1e-5, atol=1e-6)
    assert float(((along - exact).abs() / exact.clamp(min=1)).max()) < 0.007


@pytest.mark.parametrize("name", ["forward", "two lobes by color"])
def test_along_rays_all_derivatives_agree_with_differences(name: str):
    phase = PHASES[name]
    kind, numbers = type(phase), [number.clone().requires_grad_() for number in phase.numbers]
    depth = random_values(3, 3, 4).requires_grad_()
    cosine = tensor(-0.9, -0.2, 0.4, 0.95).requires_grad_()

    def found(depth: Tensor, cosine: Tensor, *numbers: Tensor) -> tuple[Tensor, ...]:
        seen = SeenPhase(kind(*numbers), 1)
        angles = cosine.acos().expand(3, 4)
        looked_up = (seen.at_angles(each, angles) for each in (depth, None))
        return seen.along(depth, cosine), *looked_up

    inputs, modes = (depth, cosine, *numbers), {"check_forward_ad": True, "fast_mode": True}
    assert torch.autograd.gradcheck(found, inputs, **modes)


# --- the scaled medium ---------------------------------------------------------------------------


@each_phase
@each_degree
def test_scaling_a_forward_peak_leaves_no_backward_rest(phase: PhaseFunction, degree: int):
    """What remains has a mean cosine, and a peak no more than all of scattering."""
    f = phase.peak_tail(degree, 1)[:, 0]
    assert bool(((f >= 0) & (f < 1)).all())
    if isinstance(phase, Tabulated | Rayleigh):
        rest = (phase.moments(2)[:, 1] - f) / (1 - f)
        assert bool((rest >= -1e-12).all())


@pytest.mark.parametrize("g", MEAN_COSINES)
def test_scaling_leaves_the_transport_extinction_alone(g: float):
    sigma_a, sigma_s = random_values(3, seed=1), random_values(3, seed=2)
    density = random_values(2, 3, 4)
    volume = Volume(box_grid((2, 3, 4)), density, sigma_a, sigma_s, scalar(g))
    exact = (sigma_a + (1 - g) * sigma_s).view(3, 1, 1, 1) * density
    for medium in (scale_medium(volume), keep_medium(volume)):
        torch.testing.assert_close(medium.transport_extinction, exact, rtol=1e-14, atol=0)
        of_rest = (medium.g - medium.forward_fraction) / (1 - medium.forward_fraction)
        by_parts = medium.absorption.value + (1 - of_rest) * medium.remaining_scattering
        torch.testing.assert_close(by_parts, exact, rtol=1e-13, atol=0)
        both = medium.absorption.value + medium.remaining_scattering
        torch.testing.assert_close(medium.extinction.value, both, rtol=1e-14, atol=0)
    removed = keep_medium(volume).extinction.value - scale_medium(volume).extinction.value
    expected = max(g, 0) ** 2 * sigma_s.view(3, 1, 1, 1) * density
    torch.testing.assert_close(removed, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("medium_of", [scale_medium, keep_medium])
def test_a_constant_cross_section_equals_the_same_one_in_every_cell(medium_of):
    sigma_a = random_values(3, seed=1)
    sigma_s = random_values(3, seed=2)
    density = random_values(2, 3, 4)
    grid = box_grid((2, 3, 4))
    fields = [sigma.view(3, 1, 1, 1).expand(3, *grid.shape) for sigma in (sigma_a, sigma_s)]
    constant, varying = (
        medium_of(Volume(grid, density, *sigmas, scalar(0.3)))
        for sigmas in ((sigma_a, sigma_s), fields)
    )
    for name in ("extinction", "scattering", "absorption"):
        one, other = (getattr(medium, name).value for medium in (constant, varying))
        torch.testing.assert_close(one, other, rtol=1e-15, atol=0)
