"""Functions of a depth from 0 to infinity, as polynomials (E8.8) in x = (depth - s) / (depth + s).

They take a few products where a closed form takes many. By interpolation at Chebyshev's extrema
(Trefethen 2019, Approximation Theory and Approximation Practice, chapter 2,
doi:10.1137/1.9781611975949).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

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


def depth_place(depth: Tensor) -> Tensor:
    """x from -1 at a `depth` of 0 to 1 at infinity."""
    return 1 - 2 * SCALE / (depth + SCALE)


def depth_at(place: Tensor) -> Tensor:
    """The depth at `place` x."""
    return (SCALE * (1 + place) / (1 - place)).clamp(max=DEEPEST)


def evaluate(coefficients: Tensor, place: Tensor) -> Tensor:
    """The polynomial of `coefficients` [K, ...], from the constant one on, at `place`."""
    value = coefficients[-1]
    for coefficient in coefficients[:-1].flip(0):
        value = torch.addcmul(coefficient, value, place)
    return value


def sum_series(coefficients: Sequence[Tensor], place: Tensor) -> Tensor:
    """The sum of `coefficients` times Chebyshev's polynomials at `place`, by Clenshaw's rule."""
    value, before = torch.zeros_like(place), torch.zeros_like(place)
    for coefficient in reversed(coefficients[1:]):
        value, before = coefficient + 2 * place * value - before, value
    return coefficients[0] + place * value - before


@functools.cache
@torch.inference_mode(False)
def extrema(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Chebyshev's extrema x [`count`], -1 first, and two matrices from values there.

    They give coefficients of powers, for `evaluate`, and of Chebyshev's series, for `sum_series`.
    """
    degrees = torch.arange(count, dtype=torch.float64)
    angle = degrees.flip(0) * (math.pi / max(1, count - 1)) if count > 1 else degrees + math.pi
    x = torch.cos(angle)
    series = torch.linalg.inv(torch.cos(degrees * angle[:, None]))
    return x, torch.linalg.inv(x[:, None] ** degrees), series
