"""Smooth functions of an angle or of a depth, as series and as tables.

Of the angle between two directions they are Legendre series, and tables of values and slopes at
even angles from 0 to pi. Between two of these a function is the cubic with their values and slopes
(Hermite), fourth order in the step and with a continuous slope.

Of a depth from 0 to infinity they are polynomials (E8.8) in x = (depth - s) / (depth + s), which
take a few products where a closed form takes many; by interpolation at Chebyshev's extrema
(Trefethen 2019, Approximation Theory and Approximation Practice, chapter 2,
doi:10.1137/1.9781611975949).
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.numerics.interpolation import weigh_rows

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
    values = [torch.zeros_like(cosine), torch.ones_like(cosine)]
    for degree in range(count - 1):
        before, value = values[-2:]
        values.append(((2 * degree + 1) * cosine * value - degree * before) / (degree + 1))
    return torch.stack(values[1:], -1)


def series_weights(moments: Tensor) -> Tensor:
    """(2 l + 1) times `moments` [..., l]: the coefficients of their Legendre series."""
    degree = torch.arange(moments.shape[-1], dtype=moments.dtype, device=moments.device)
    return (2 * degree + 1) * moments


@functools.cache
@torch.inference_mode(False)
def fejer(count: int) -> tuple[Tensor, Tensor]:
    """Even angles and weights [`count`] of a rule over their cosines, exact to degree `count` - 1.

    Fejer's first rule (Waldvogel 2006, doi:10.1007/s10543-006-0045-4).
    """
    angle = (torch.arange(count, dtype=torch.float64) + 0.5) * (math.pi / count)
    k = torch.arange(1, count // 2 + 1, dtype=torch.float64)
    series = torch.cos(2 * angle[:, None] * k) @ (1 / (4 * k**2 - 1))
    return angle, (1 - 2 * series) * (2 / count)


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


STEPS = 1024
"""Steps of a table: a Henyey-Greenstein peak of g = 0.95 is 16 of them wide."""
NEAREST = 1e-14
"""Cosines are held so far from -1 and 1, where the angle has no slope."""


def angle_of(cosine: Tensor) -> Tensor:
    """The angle in double precision; its derivative by `cosine` is finite, at -1 and 1 as well."""
    return cosine.double().clamp(NEAREST - 1, 1 - NEAREST).acos()


def look_up(table: Tensor, angle: Tensor) -> Tensor:
    """Values [C, *angle.shape, K] at `angle` of the functions in `table` [C, steps + 1, 2, K].

    The two entries are value and slope by the angle. Values have the precision of `table`.
    """
    colors, steps = len(table), table.shape[1] - 1
    place = angle.flatten() / (math.pi / steps)
    first = place.detach().long().clamp(0, steps - 1)
    weights = torch.stack(_cubic((place - first).to(table.dtype), math.pi / steps), -1)
    # Values and slopes at both ends of a step stand beside each other.
    rows = 2 * first[:, None] + torch.arange(4, device=place.device)
    values = torch.stack([weigh_rows(curves.flatten(0, 1), rows, weights) for curves in table])
    return values.view(colors, *angle.shape, table.shape[-1])


def _cubic(t: Any, step: Any) -> tuple[Any, Any, Any, Any]:
    """Weights of values and slopes at both ends of a `step`, the part `t` of it on (Hermite)."""
    u = 1 - t
    return (1 + 2 * t) * u**2, step * t * u**2, (1 + 2 * u) * t**2, -step * u * t**2


def with_slopes(values: Tensor) -> Tensor:
    """`values` [C, steps + 1] at even angles as a table [C, steps + 1, 2, 1].

    Slopes are differences of fourth order; functions are even about both ends.
    """
    steps = values.shape[1] - 1
    before, after = values[:, 1:3].flip(1), values[:, -3:-1].flip(1)
    wide = torch.cat([before, values, after], 1)
    near, far = wide[:, 3:-1] - wide[:, 1:-3], wide[:, 4:] - wide[:, :-4]
    slopes = (8 * near - far) * (steps / (12 * math.pi))
    return torch.stack([values, slopes], -1)[..., None]


def at_even_angles(angles: np.ndarray, values: np.ndarray) -> np.ndarray:
    """`values` [C, n] >= 0 given at `angles` [n] from 0 to pi, at even angles: [C, STEPS + 1].

    Between neighbors they are monotone, by the piecewise cubics of Fritsch and Butland 1984
    (doi:10.1137/0905021), which are even about both ends.
    """
    widths = np.diff(angles)
    rises = np.diff(values, axis=1) / widths
    before, after = widths[:-1], widths[1:]
    weights = (2 * after + before), (after + 2 * before)
    is_monotone = rises[:, :-1] * rises[:, 1:] > 0
    low, high = (np.where(is_monotone, rise, 1) for rise in (rises[:, :-1], rises[:, 1:]))
    inner = sum(weights) / (weights[0] / low + weights[1] / high)
    slopes = np.pad(np.where(is_monotone, inner, 0), ((0, 0), (1, 1)))
    places = np.linspace(0, math.pi, STEPS + 1)
    node = np.searchsorted(angles, places, side="right").clip(1, len(angles) - 1) - 1
    entries = values[:, node], slopes[:, node], values[:, node + 1], slopes[:, node + 1]
    cubic = _cubic((places - angles[node]) / widths[node], widths[node])
    return np.sum([weight * entry for weight, entry in zip(cubic, entries, strict=True)], axis=0)
