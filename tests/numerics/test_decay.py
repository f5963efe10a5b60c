"""Exponential decay over a segment: closed forms, quadrature, and rounding at every depth."""

import numpy as np
import pytest
import torch
from media import random_values

from ddrecon.numerics.decay import SERIES_BELOW, decay_mean, decay_terms, decayed_sum

DEPTHS = (0.0, 1e-6, SERIES_BELOW - 1e-3, SERIES_BELOW + 1e-3, 0.3, 5.0, 50.0, 1e4)


def mean_by_quadrature(begin, end):
    """The mean of exp(-depth) for depth going linearly from `begin` to `end`."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    return float((np.exp(-(begin + (end - begin) * (nodes + 1) / 2)) * weights).sum() / 2)


def segments():
    """weight, begin, end, scale of some segments, empty ones and both directions among them."""
    weight, begin, end = (random_values(6, 1, 4, seed=seed) for seed in range(3))
    end[0] = begin[0]
    return [weight, begin, end, 0.5 + random_values(3, 1, seed=3)]


def test_the_mean_decay_of_an_opaque_step_is_one_over_its_depth():
    depth = torch.tensor([1e4, 1e8], dtype=torch.float64)
    torch.testing.assert_close(decay_mean(depth), 1 / depth, rtol=1e-15, atol=0)


def test_decayed_sums_against_quadrature():
    weight, begin, end, scale = segments()
    total = decayed_sum(weight, begin, end, scale)
    for c in range(3):
        for r in range(4):
            known = 0.0
            for s in range(6):
                ends = (scale[c] * one[s, 0, r] for one in (begin, end))
                known += float(weight[s, 0, r]) * mean_by_quadrature(*map(float, ends))
            assert float(total[c, r]) == pytest.approx(known, rel=1e-13)


def test_both_modes_have_derivatives():
    """Of thick, thin and empty steps, and where nodes share the same depth."""
    weight, begin, end, scale = (one.requires_grad_() for one in segments())
    assert torch.autograd.gradcheck(
        lambda w, b, e, s: decayed_sum(w, b, e + 0.1, s),
        (weight, begin, end, scale),
        check_forward_ad=True,
    )
    depth = (1e-5 + torch.tensor(DEPTHS[:-1], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(decay_terms, depth, check_forward_ad=True)


@pytest.mark.parametrize("depth", DEPTHS)
def test_single_precision_follows_double(depth):
    """The derivative is a difference: rounding grows by 1 / depth if thin, by depth if thick."""
    slopes, means = [], []
    for dtype in (torch.float32, torch.float64):
        point = torch.tensor([depth], dtype=dtype, requires_grad=True)
        means.append(decay_mean(point))
        slopes.append(torch.autograd.grad(means[-1].sum(), point)[0].item())
    epsilon = torch.finfo(torch.float32).eps
    assert means[0].item() == pytest.approx(means[1].item(), rel=4 * epsilon)
    assert slopes[0] == pytest.approx(slopes[1], rel=8 * epsilon * max(1 / SERIES_BELOW, depth))


@pytest.mark.parametrize("depth", [depth for depth in DEPTHS if depth <= 50])
def test_what_leaves_a_step_and_is_on_it_against_quadrature(depth):
    """Of what is emitted evenly, and in proportion to the way from the middle."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    part, weights = (nodes + 1) / 2, weights / 2
    later = weights @ np.exp(-depth * np.outer(part, 1 - part)) * (1 - part)
    phi, psi, eta = (float(one) for one in decay_terms(torch.tensor(depth, dtype=torch.float64)))
    for emitted, leaves, own in ((1 + 0 * part, phi, psi), (part - 0.5, depth * eta, -eta)):
        assert weights @ (emitted * np.exp(-depth * (1 - part))) == pytest.approx(leaves, 1e-12)
        assert weights @ (emitted * later) == pytest.approx(own, rel=1e-11)
