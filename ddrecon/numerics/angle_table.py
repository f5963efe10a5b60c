"""Smooth functions of an angle, kept as values and slopes at even angles from 0 to pi.

Between two of them a function is the cubic with their values and slopes (Hermite), fourth order in
the step and with a continuous slope.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

STEPS = 1024
"""Steps of a table: a Henyey-Greenstein peak of g = 0.95 is 16 of them wide."""
NEAREST = 1e-14
"""Cosines are held so far from -1 and 1, where the angle has no slope."""


def angle_of(cosine: Tensor) -> Tensor:
    """The angle in double precision; its derivative by `cosine` is finite, at -1 and 1 as well."""
    return cosine.double().clamp(NEAREST - 1, 1 - NEAREST).acos()


def look_up(table: Tensor, angle: Tensor) -> Tensor:
    """Values [C, *angle.shape, K] at `angle` of the functions in `table` [C, steps + 1, 2, K].

    The two entries are value and slope by the angle.
    """
    steps = table.shape[1] - 1
    place = angle.flatten() * (steps / math.pi)
    first = place.detach().long().clamp(0, steps - 1)
    part = (place - first).to(table.dtype)[:, None]
    rest = 1 - part
    low, high = table.index_select(1, first), table.index_select(1, first + 1)
    # Hermite's cubic: values by (1 + 2 t)(1 - t)^2, slopes by t (1 - t)^2, and mirrored.
    value = (1 + 2 * part) * rest**2 * low[:, :, 0] + (1 + 2 * rest) * part**2 * high[:, :, 0]
    bend = part * rest * (rest * low[:, :, 1] - part * high[:, :, 1])
    return (value + math.pi / steps * bend).unflatten(1, angle.shape or (1,))


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
