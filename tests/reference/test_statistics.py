"""Noise from passes, and errors less noise."""

import math

import numpy as np
import pytest

from ddrecon.reference.trace import Traced

TRUTH = 1 + np.arange(64 * 64 * 3).reshape(64, 64, 3) / 5000
SIGMA, PASSES = 0.5, 8


@pytest.fixture
def traced() -> Traced:
    random = np.random.default_rng(0)
    return Traced.of([TRUTH + SIGMA * random.normal(size=TRUTH.shape) for _ in range(PASSES)])


def test_noise_is_that_of_the_mean(traced: Traced) -> None:
    assert traced.noise == pytest.approx(SIGMA / math.sqrt(PASSES * (TRUTH**2).mean()), rel=0.03)


def test_an_error_is_told_through_noise(traced: Traced) -> None:
    assert traced.distance(1.1 * TRUTH) > 0.1
    assert traced.error(1.1 * TRUTH) == pytest.approx(0.1, rel=0.05)
    assert traced.error(TRUTH) < 0.3 * traced.noise
    assert traced.error(traced.image) == 0


def test_a_black_image() -> None:
    black = Traced.of([np.zeros((2, 2, 3))] * 4)
    assert (black.noise, black.error(np.zeros((2, 2, 3)))) == (0, 0)
