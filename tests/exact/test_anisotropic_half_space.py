"""A half-space of Henyey and Greenstein's phase function, lit from straight above.

Its reflection R, by which radiance is mu0 E / pi R(mu, mu0), is that which another thin layer on
top does not change (Ambartsumian). In the mean over azimuths, with albedo w and
P(mu, mu') = sum of (2l+1) g^l P_l(mu) P_l(mu'), and with integrals over cosines from 0 to 1,

    (mu + mu0) R = w/4 P(-mu, mu0) + w/2 mu0 int P(mu, .) R(., mu0) + w/2 mu int R(mu, .) P(., mu0)
                   + w mu mu0 int int R(mu, .) P(-., .) R(., mu0).

Solved by iteration: Mishchenko et al. 1999, doi:10.1016/S0022-4073(99)00028-X.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from half_spaces import IRRADIANCE, VIEWS, half_space, relative_rms, seen
from numpy.typing import NDArray
from test_half_space import h_function

pytestmark = pytest.mark.slow
NODES = 48
"""Gauss's nodes of the integrals."""


@cache
def reflection(albedo: float, g: float) -> NDArray[np.float64]:
    """R(mu, mu0) at `VIEWS` x `VIEWS`."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    # what is asked for stands beside the nodes, with weight 0
    cosines = np.concatenate([(nodes + 1) / 2, VIEWS])
    weights = np.concatenate([weights / 2, np.zeros(len(VIEWS))])
    terms = np.sqrt(2 * np.arange(2 * NODES) + 1)
    ups = np.polynomial.legendre.legvander(cosines, 2 * NODES - 1) * terms
    downs = np.polynomial.legendre.legvander(-cosines, 2 * NODES - 1) * terms
    moments = g ** np.arange(2.0 * NODES)
    ahead, back = ups * moments @ ups.T, downs * moments @ ups.T
    mu, mu0 = cosines[:, None], cosines[None]
    found = np.zeros_like(back)
    for _ in range(4000):
        into = ahead * weights @ found
        right = back / 4 + (mu0 * into + mu * into.T) / 2
        right = right + mu * mu0 * (found * weights @ back * weights @ found)
        new = albedo * right / (mu + mu0)
        if np.abs(new - found).max() < 1e-12:
            break
        found = new
    return found[NODES:, NODES:]


def test_reflection_without_anisotropy_is_chandrasekhars() -> None:
    wanted = [
        [0.9 / 4 * h_function(0.9, mu) * h_function(0.9, mu0) / (mu + mu0) for mu0 in VIEWS]
        for mu in VIEWS
    ]
    assert reflection(0.9, 0.0) == pytest.approx(np.array(wanted), rel=1e-5)


@pytest.mark.parametrize(("albedo", "g"), [(0.9, -0.7), (0.99, -0.4), (0.99, 0.7)])
def test_radiance_is_the_exact_one(albedo: float, g: float) -> None:
    """Measured: 0.0034, 0.0117 and 0.0154 after three rounds, where P1 is 0.028 to 0.060 off."""
    wanted = (IRRADIANCE / np.pi * reflection(albedo, g)[:, 0]).tolist()
    diffuse, found = (
        relative_rms(seen(half_space(albedo, 1.0, 96, rounds, g)), wanted) for rounds in (0, 3)
    )
    assert found < 0.018 and found < 0.4 * diffuse
