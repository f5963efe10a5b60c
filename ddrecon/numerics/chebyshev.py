"""Functions of a depth from 0 to infinity, as polynomials (E8.8) in x = (depth - s) / (depth + s).

They take a few products where a closed form takes many. By interpolation at Chebyshev's extrema
(Trefethen 2019, Approximation Theory and Approximation Practice, chapter 2,
doi:10.1137/1.9781611975949).
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

COEFFICIENTS = 12
"""One more than the degree of the polynomials."""
SCALE = 8.0
"""The depth s, taken to the middle of the polynomial's interval, x = 0.

It suits the one function that is fitted, the phase function E8.7: at g = 0.95 that is off by 0.0064
with 8, by 0.010 with 6 or 12, by 0.04 with 2 or 20.
"""
DEEPEST = 1e6
"""Stands for infinite depth."""


def evaluate_positive(coefficients: Tensor, depth: Tensor) -> Tensor:
    """Polynomials of `coefficients` [COEFFICIENTS, ...] at `depth` >= 0, held at zero.

    The others of their axes broadcast against those of `depth`, [N, C, R].
    """
    x = 1 - 2 * SCALE / (depth + SCALE)
    value = coefficients[-1].expand_as(x)
    for coefficient in coefficients[:-1].flip(0):
        value = torch.addcmul(coefficient, value, x)
    return value.clamp(min=0)


@functools.cache
@torch.inference_mode(False)
def extrema() -> tuple[Tensor, Tensor]:
    """Depths [COEFFICIENTS] at Chebyshev's extrema, and the matrix from values to coefficients."""
    angle = torch.arange(COEFFICIENTS, dtype=torch.float64) * (math.pi / (COEFFICIENTS - 1))
    x = -torch.cos(angle)
    depths = (SCALE * (1 + x) / (1 - x)).clamp(max=DEEPEST)
    return depths, torch.linalg.inv(torch.linalg.vander(x))
