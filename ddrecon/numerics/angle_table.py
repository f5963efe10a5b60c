"""Smooth functions of an angle, kept as values and slopes at even angles from 0 to pi.

Between two of them a function is the cubic with their values and slopes (Hermite), fourth order in
the step and with a continuous slope.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ddrecon.numerics.interpolation import weigh_rows

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
    left = np.searchsorted(angles, places, side="right").clip(1, len(angles) - 1) - 1
    entries = values[:, left], slopes[:, left], values[:, left + 1], slopes[:, left + 1]
    cubic = _cubic((places - angles[left]) / widths[left], widths[left])
    return np.sum([weight * entry for weight, entry in zip(cubic, entries, strict=True)], axis=0)
