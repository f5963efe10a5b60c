"""Phase functions and the scaling of their peak, checked by their moments over the sphere."""

import math

import numpy as np
import pytest
import torch
from media import box_grid, make_scene, random_values, summed_series, tensor

from ddrecon.medium.coefficients import Volume, keep_medium, scale_medium
from ddrecon.medium.phase import (
    Blend,
    HenyeyGreenstein,
    PhaseFunction,
    Rayleigh,
    SeenPhase,
    Tabulated,
    TwoLobe,
)
from ddrecon.numerics.autodiff import tensors_in
from ddrecon.numerics.series import STEPS, even_angles
from ddrecon.picture import render

MEAN_COSINES = (-0.8, -0.3, 0.0, 0.4, 0.8)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(100)


def scalar(value):
    return torch.tensor(value, dtype=torch.float64)


def bump():
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


def legendre_moments(values, count):
    """The averages [C, count] of P_l over the sphere, weighted by values [C, n] at NODES."""
    rows = np.polynomial.legendre.legvander(NODES, count - 1) * WEIGHTS[:, None] / 2
    return values @ torch.from_numpy(rows)


@each_phase
def test_moments_are_those_of_the_values(phase):
    found = legendre_moments(phase.value(torch.tensor(NODES)), 12)
    torch.testing.assert_close(found, phase.moments(12), rtol=0, atol=1e-7)
    assert len(found) == phase.colors
    assert torch.equal(phase.moments(1), torch.ones_like(phase.moments(1)))


TWO = TwoLobe(tensor(0.6, -0.3), scalar(0.4))


@pytest.mark.parametrize(
    "special, general",
    [
        (TwoLobe(tensor(0.6, -0.9), scalar(1.0)), HenyeyGreenstein(scalar(0.6))),
        (TwoLobe(tensor(0.6, -0.9), scalar(0.0)), HenyeyGreenstein(scalar(-0.9))),
        (Blend(*TWO.parts, scalar(0.4)), TWO),
        (Tabulated(1 + even_angles(STEPS).cos()[None] ** 2), Rayleigh(scalar(0.0))),
    ],
)
def test_special_cases_are_each_other(special, general):
    cosine = torch.linspace(-1, 1, 37, dtype=torch.float64)
    torch.testing.assert_close(special.value(cosine), general.value(cosine), rtol=1e-7, atol=1e-7)
    torch.testing.assert_close(special.moments(30), general.moments(30), rtol=0, atol=1e-10)
    for degree in (1, 3):
        tails = (phase.peak_tail(degree, 1) for phase in (special, general))
        torch.testing.assert_close(*tails, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", [name for name in PHASES if name not in ("rayleigh", "table")])
def test_all_that_is_asked_has_both_derivatives(name):
    """Values, moments, and what beams with a peak and without one are seen by."""
    phase, cosine = PHASES[name], tensor(-0.9, -0.2, 0.4, 0.95).requires_grad_()
    numbers = [number.clone().requires_grad_() for number in tensors_in(phase)]
    depth = random_values(3, phase.colors, 4).requires_grad_()

    def ask(depth, cosine, *numbers):
        others = iter(numbers)
        other = phase.map(lambda _: next(others))
        tails, seen = (other.peak_tail(1, 4), other.peak_tail(3, 4, -1)), SeenPhase(other, 1)
        at_angles = (seen.at_angles(x, cosine.acos().expand(3, 4)) for x in (depth, None))
        return other.value(cosine), other.moments(5), *tails, seen.along(depth, cosine), *at_angles

    inputs, modes = (depth, cosine, *numbers), {"check_forward_ad": True, "fast_mode": True}
    assert torch.autograd.gradcheck(ask, inputs, **modes)


# --- what a forward peak does to a beam ----------------------------------------------------------


def peak_moment(g, depth, degree, top):
    """The moment of light that the forward peak alone has scattered, on a way of `depth`.

    n scatterings fall on it with Poisson's probability, each is the one in question with 1 / n,
    and n in a row have the moments of one to the power of n: 1 up to `top`, then g, g^2, ...
    """
    counts = range(1, 80)
    chances = [math.exp(-depth) * depth ** (n - 1) / math.factorial(n) for n in counts]
    return g ** (top + 1) * sum(
        chance * g ** (n * max(0, degree - top - 1))
        for chance, n in zip(chances, counts, strict=True)
    )


@pytest.mark.parametrize("g", [0.05, 0.2, 0.4])
@pytest.mark.parametrize("depth", [1e-9, 0.3, 2.0, 9.0])
@each_degree
def test_a_peak_spreads_light_by_the_moments_of_its_scatterings(g, depth, degree):
    seen = SeenPhase(HenyeyGreenstein(scalar(g)), degree)
    found = legendre_moments(summed_series(seen, tensor(depth)[None], torch.tensor(NODES)), 8)[0]
    for moment in range(8):
        rest = g**moment - g ** (degree + 1) if moment <= degree else 0.0
        expected = rest + peak_moment(g, depth, moment, degree)
        assert float(found[moment]) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize(
    "phase",
    [*PHASES.values(), *(HenyeyGreenstein(scalar(g)) for g in (0.1, 0.95))],
    ids=[*PHASES, "0.1", "0.95"],
)
@each_degree
def test_along_rays_a_spread_peak_is_nearly_the_same(phase, degree):
    """And where nothing lies behind it, it is the exact phase function."""
    cosine = torch.linspace(-1, 1, 101, dtype=torch.float64)
    depth = torch.cat([torch.zeros(1), torch.logspace(-4, 4, 100)]).double().view(-1, 1, 1)
    seen, exact = SeenPhase(phase, degree), phase.value(cosine)
    along = seen.along(depth.expand(-1, len(exact), 101), cosine)
    summed = torch.stack([summed_series(seen, x.expand(len(exact), 1), cosine) for x in depth])
    for without in (along[0], summed[0]):
        torch.testing.assert_close(without, exact, rtol=1e-6, atol=1e-6)
    assert float(((along - summed).abs() / summed.clamp(min=1)).max()) < 0.007


@each_phase
def test_a_spread_peak_is_finite_and_not_negative_at_any_depth(phase):
    depth = torch.logspace(-30, 10, 21).view(-1, 1, 1).requires_grad_()
    cosine = torch.linspace(-1, 1, 21).requires_grad_()
    found = SeenPhase(phase, 3).along(depth.expand(-1, phase.colors, 21), cosine)
    bars = torch.autograd.grad(found.sum(), (depth, cosine))
    assert (found >= 0).all()
    assert all(bool(each.isfinite().all()) for each in (found, *bars))


# --- the scaled medium ---------------------------------------------------------------------------


@each_phase
@each_degree
def test_scaling_a_forward_peak_leaves_no_backward_rest(phase, degree):
    """What remains has a mean cosine, and a peak no more than all of scattering."""
    f = phase.peak_tail(degree, 1)[:, 0]
    assert bool(((f >= 0) & (f < 1)).all())
    if isinstance(phase, Tabulated | Rayleigh):
        rest = (phase.moments(2)[:, 1] - f) / (1 - f)
        assert bool((rest >= -1e-12).all())


@pytest.mark.parametrize("varies", [False, True])
@pytest.mark.parametrize("g", MEAN_COSINES)
def test_scaling_leaves_the_transport_extinction_alone(g, varies):
    """Cross sections may be the same in all cells, or given cell by cell."""
    grid, density = box_grid((2, 3, 4)), random_values(2, 3, 4)
    cells = grid.shape if varies else (1, 1, 1)
    sigmas = random_values(3, *cells, seed=1), random_values(3, *cells, seed=2)
    volume = Volume(grid, density, *(s if varies else s.flatten() for s in sigmas), scalar(g))
    absorbed, scattered = (sigma * density for sigma in sigmas)
    exact = absorbed + (1 - g) * scattered
    for medium, f in ((scale_medium(volume), max(g, 0) ** 2), (keep_medium(volume), 0.0)):
        remaining = (1 - f) * scattered
        for coefficient, known in (
            (medium.absorption.value, absorbed),
            (medium.scattering.value, scattered),
            (medium.remaining_scattering, remaining),
            (medium.extinction.value, absorbed + remaining),
            (medium.transport_extinction, exact),
        ):
            torch.testing.assert_close(coefficient, known, rtol=1e-14, atol=1e-16)
        of_rest = (medium.g - medium.forward_fraction) / (1 - medium.forward_fraction)
        by_parts = medium.absorption.value + (1 - of_rest) * medium.remaining_scattering
        torch.testing.assert_close(by_parts, exact, rtol=1e-13, atol=0)


# --- numbers that differ from cell to cell ---

SHAPE = (5, 4, 6)
LOBES = torch.tensor([0.8, -0.4], dtype=torch.float64)
HAZE = HenyeyGreenstein(torch.tensor([0.7, 0.6, -0.5], dtype=torch.float64))
AIR = Rayleigh(LOBES[0])
FIELDS: dict[str, PhaseFunction] = {
    "g": HenyeyGreenstein(1.7 * random_values(*SHAPE, seed=3) - 0.8),
    "weight": TwoLobe(LOBES, random_values(*SHAPE, seed=4)),
    "blend by color": Blend(HAZE, AIR, random_values(3, *SHAPE, seed=5)),
}
each_field = pytest.mark.parametrize("phase", FIELDS.values(), ids=FIELDS.keys())


def scene_of(phase, **changes):
    """Cross sections are given cell by cell, as coefficients are where a phase function is."""
    sigma_s = torch.tensor([8.0, 6.0, 4.0], dtype=torch.float64).view(3, 1, 1, 1)
    given = {"sigma_s": sigma_s.expand(3, *SHAPE), "ambient": (0.3,)} | changes
    scene = make_scene(random_values(*SHAPE), **given)
    scene.volume.phase = phase
    return scene


@pytest.mark.slow
@pytest.mark.parametrize("rounds", [0, 2])
@pytest.mark.parametrize(
    "phase, is_looked_up",
    [
        *((HenyeyGreenstein(LOBES.new_tensor(g)), g > 0) for g in (0.7, 0.0, -0.5)),
        *((TwoLobe(g, LOBES.new_tensor(0.3)), bool(g.min() > 0)) for g in (LOBES, LOBES.abs())),
        (Blend(HAZE, AIR, LOBES.new_tensor([0.3, 0.8, 0.5])), False),
    ],
    ids=["forward", "isotropic", "backward", "two lobes", "two forward lobes", "blend by color"],
)
def test_the_same_in_every_cell_is_one_number(phase, is_looked_up, rounds):
    """To rounding, or as closely as functions are looked up by their number."""
    number = [*tensors_in(phase)][-1]
    cells = phase.with_cells(number.view(*number.shape, 1, 1, 1).expand(*number.shape, *SHAPE))
    # along an axis: on their way across the grid pairs of cells are interpolated otherwise
    changes = {"transport_rounds": rounds, "travel": (0.0, -1.0, 0.0)}
    one, other = (render(scene_of(each, **changes)) for each in (phase, cells))
    has_pairs = rounds > 0 and float(phase.peak_tail(3, 1, -1).max()) > 0
    tolerance = 1e-3 if is_looked_up or has_pairs else 1e-11
    torch.testing.assert_close(other, one, rtol=tolerance, atol=0)


BETWEEN = [
    *((HenyeyGreenstein(scalar(g)), d, 0.01) for g in (0.013, 0.333, 0.777, 0.949) for d in (1, 3)),
    # Exact at both ends, and nearly where one lobe alone has a peak.
    *((TwoLobe(LOBES, scalar(weight)), 3, 1e-3) for weight in (0.03, 0.41)),
    *((TwoLobe(tensor(0.85, 0.6), scalar(weight)), 3, 0.02) for weight in (0.03, 0.41)),
    *((TwoLobe(lobes, scalar(w)), 3, 1e-10) for lobes in (LOBES, LOBES.abs()) for w in (0.0, 1.0)),
    # At any weight, since the peaks of both spread light together.
    (TwoLobe(tensor(0.8, 0.8), scalar(0.3)), 3, 1e-12),
]


@pytest.mark.parametrize(("phase", "degree", "close"), BETWEEN)
def test_between_the_numbers_of_its_table_s_is_that_of_the_number(phase, degree, close):
    """Of one at nodes, beside that of `phase` itself; and p, where there is no peak."""
    depth, cosine = 4 * random_values(7, 1, 9), 2 * random_values(9, seed=1) - 1
    number = [*tensors_in(phase)][-1]
    cells = SeenPhase(phase.with_cells(number.expand(1, 1, 1)), degree, number.expand(7, 1, 9))
    for factor, most in ((1, close), (0, 1e-5)):
        found, expected = (
            seen.along(factor * depth, cosine) for seen in (cells, SeenPhase(phase, degree))
        )
        assert float(((found - expected).abs() / expected.clamp(min=1)).max()) < most


@each_field
def test_cells_without_scattering_have_no_phase_function(phase):
    """Their number changes moments of nothing, and its derivative is zero and finite."""
    density = random_values(*SHAPE)
    density[:, :, 3:] = 0
    number = phase.cells.clone().requires_grad_()
    scene = scene_of(phase.with_cells(number), transport_rounds=1)
    scene.volume.density = density
    medium = scale_medium(scene.volume, 3)
    assert bool(torch.isfinite(medium.peak).all())
    (bar,) = torch.autograd.grad(render(scene).sum(), number)
    assert bool(torch.isfinite(bar).all()) and bool((bar[..., 5] == 0).all())
