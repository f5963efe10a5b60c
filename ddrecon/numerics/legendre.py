"""Legendre series over the angle between two directions."""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Iterator

import torch
from torch import Tensor

COUNTS = tuple(2**power for power in range(5, 12))
"""Lengths of series: few of them, so that few matrices are kept."""


def even_angles(steps: int) -> Tensor:
    """Angles [`steps` + 1] from 0 to pi in even steps, in double precision."""
    return torch.linspace(0, math.pi, steps + 1, dtype=torch.float64)


@functools.lru_cache(maxsize=4)
@torch.inference_mode(False)
def legendre_at_even_angles(steps: int, count: int) -> tuple[Tensor, Tensor]:
    """P_l(cos angle) for l < `count` at `even_angles`, and its derivatives by the angle.

    Both are [`steps` + 1, `count`].
    """
    angle = even_angles(steps)
    cosine, sine = angle.cos(), angle.sin()
    rows = legendre(cosine, count)
    # sin(angle) dP_l / d angle = l (cos(angle) P_l - P_(l-1)); at both ends the slope is 0.
    degree = torch.arange(count, dtype=torch.float64)
    before = torch.cat([torch.zeros_like(rows[:, :1]), rows[:, :-1]], 1)
    slopes = degree * (cosine[:, None] * rows - before) / sine[:, None]
    slopes[0] = slopes[-1] = 0
    return rows, slopes


def legendre(cosine: Tensor, count: int) -> Tensor:
    """P_l(`cosine`) for l < `count`, as a new last axis."""
    return torch.stack([*_each_legendre(cosine, count)], -1)


def _each_legendre(cosine: Tensor, count: int) -> Iterator[Tensor]:
    """P_l(`cosine`) for l < `count`, one at a time."""
    before, value = torch.zeros_like(cosine), torch.ones_like(cosine)
    for degree in range(count):
        yield value
        after = ((2 * degree + 1) * cosine * value - degree * before) / (degree + 1)
        before, value = value, after


def series_weights(moments: Tensor) -> Tensor:
    """(2 l + 1) times `moments` [..., l]: the coefficients of their Legendre series."""
    degree = torch.arange(moments.shape[-1], dtype=moments.dtype, device=moments.device)
    return (2 * degree + 1) * moments


NEWTON_STEPS = 5
"""From the first guess to all digits."""


@functools.cache
@torch.inference_mode(False)
def gauss_legendre(count: int) -> tuple[Tensor, Tensor]:
    """Cosines and weights [`count`] of Gauss's rule on [-1, 1], exact to degree 2 `count` - 1.

    By Newton's method on P_count, all at once: NumPy's takes seconds for thousands of nodes.
    """
    place = torch.arange(count, dtype=torch.float64) + 0.75
    cosine = torch.cos(place * (math.pi / (count + 0.5)))
    for _ in range(NEWTON_STEPS):
        value, slope = _last_legendre(cosine, count)
        cosine = cosine - value / slope
    _, slope = _last_legendre(cosine, count)
    return cosine, 2 / ((1 - cosine**2) * slope**2)


def _last_legendre(cosine: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """P_degree(`cosine`) and its derivative."""
    before, value = deque(_each_legendre(cosine, degree + 1), maxlen=2)
    return value, degree * (cosine * value - before) / (cosine**2 - 1)
