"""Exponential decay over a segment: closed forms, quadrature, and rounding at every depth."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from media import random_values
from torch import Tensor

from ddrecon.numerics.decay import SERIES_BELOW, decay_mean, decayed_line, decayed_sum

DEPTHS = (0.0, 1e-6, SERIES_BELOW - 1e-3, SERIES_BELOW + 1e-3, 0.3, 5.0, 50.0, 1e4)


def mean_by_quadrature(begin: float, end: float) -> float:
    """The mean of exp(-depth) for depth going linearly from `begin` to `end`."""
    nodes, weights = np.polynomial.legendre.leggauss(60)
    return float((np.exp(-(begin + (end - begin) * (nodes + 1) / 2)) * weights).sum() / 2)


def segments() -> list[Tensor]:
    """weight, begin, end, scale of some segments, empty ones and both directions among them."""
    weight, begin, end = (random_values(6, 1, 4, seed=seed) for seed in range(3))
    end[0] = begin[0]
    return [weight, begin, end, 0.5 + random_values(3, 1, seed=3)]


@pytest.mark.parametrize("depth", [depth for depth in DEPTHS if depth <= 50])
def test_the_mean_decay_is_the_mean_of_the_exponential(depth: float):
    assert decay_mean(torch.tensor([depth], dtype=torch.float64)).item() == pytest.approx(
        mean_by_quadrature(0, depth), rel=1e-13
    )


def test_the_mean_decay_of_an_opaque_step_is_one_over_its_depth():
    depth = torch.tensor([1e4, 1e8], dtype=torch.float64)
    torch.testing.assert_close(
        decay_mean(depth) * depth, torch.ones_like(depth), rtol=1e-15, atol=0
    )


def test_decayed_sums_against_quadrature():
    weight, begin, end, scale = segments()
    total = decayed_sum(weight, begin, end, scale)
    for c in range(3):
        for r in range(4):
            parts = [
                weight[s, 0, r].item()
                * mean_by_quadrature(
                    (scale[c] * begin[s, 0, r]).item(), (scale[c] * end[s, 0, r]).item()
                )
                for s in range(6)
            ]
            assert total[c, r].item() == pytest.approx(sum(parts), rel=1e-13)


def test_both_modes_have_derivatives():
    """Of thick, thin and empty steps, and where nodes share the same depth."""
    weight, begin, end, scale = (one.requires_grad_() for one in segments())
    assert torch.autograd.gradcheck(
        lambda w, b, e, s: decayed_sum(w, b, e + 0.1, s),
        (weight, begin, end, scale),
        check_forward_ad=True,
    )
    near, far = (random_values(len(DEPTHS) - 1, 1, 3, seed=seed) for seed in (4, 5))
    depth = (1e-5 + torch.tensor(DEPTHS[:-1], dtype=torch.float64)).view(-1, 1, 1)
    inputs = [one.clone().requires_grad_() for one in (near, far, depth)]
    assert torch.autograd.gradcheck(decayed_line, inputs, check_forward_ad=True)


@pytest.mark.parametrize("depth", DEPTHS)
def test_single_precision_follows_double(depth: float):
    """The derivative is a difference of nearly equal numbers: rounding grows by 1 / depth when thin
    and by depth when thick.
    """
    slopes, means = [], []
    for dtype in (torch.float32, torch.float64):
        point = torch.tensor([depth], dtype=dtype, requires_grad=True)
        means.append(decay_mean(point))
        slopes.append(torch.autograd.grad(means[-1].sum(), point)[0].item())
    epsilon = torch.finfo(torch.float32).eps
    assert means[0].item() == pytest.approx(means[1].item(), rel=4 * epsilon)
    assert slopes[0] == pytest.approx(slopes[1], rel=8 * epsilon * max(1 / SERIES_BELOW, depth))


@pytest.mark.parametrize("depth", DEPTHS[:-1])
def test_a_decayed_line_against_quadrature(depth: float):
    nodes, weights = np.polynomial.legendre.leggauss(60)
    part = (nodes + 1) / 2
    expected = float(((0.7 + (2.5 - 0.7) * part) * np.exp(-depth * part) * weights).sum() / 2)
    near, far, depths = (
        torch.full((1, 1, 1), value, dtype=torch.float64) for value in (0.7, 2.5, depth)
    )
    line, lost = decayed_line(near, far, depths)
    assert line.item() == pytest.approx(expected, rel=1e-11) and lost.item() == pytest.approx(
        -math.expm1(-depth), rel=1e-14
    )
