"""Exponential decay integrated in closed form over steps on which the optical depth is linear.

Over depths from a to b >= a the mean of exp(-depth) is exp(-a) phi(b - a), with

    phi(d) = (1 - exp(-d)) / d,    psi(d) = phi + phi' = (1 - phi) / d.

Where d is small psi is its series: its closed form is a difference of nearly equal numbers there.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import is_varied

SERIES_BELOW = 1e-2
"""Below this depth psi is its series."""
TERMS = 6
"""Of the series: the next one, and its slope, are below rounding."""


def decay_mean(depth: Tensor) -> Tensor:
    """phi(`depth`): the mean of exp(-depth s) over s in [0, 1]; `depth` >= 0, of any shape."""
    at = depth.detach()
    shifted = at + torch.finfo(at.dtype).tiny
    phi = -torch.expm1(-shifted) / shifted
    if not is_varied(depth):
        return phi
    # The second term is 0 and has the slope: so one array is kept, where autograd would keep ten.
    return phi + (_psi(at, phi) - phi) * (depth - at)


def decayed_sum(weight: Tensor, begin: Tensor, end: Tensor, scale: Tensor) -> Tensor:
    """Sum over segments of `weight` times the mean of exp(-depth) there, `[C, R]`.

    `scale` [C, 1] times `begin` and `end` [S, K, R] >= 0 are the depths at both ends of each of S
    segments, in either order; `weight`: [S, K or C, R]. K is 1 or C.
    """
    decay = torch.exp(-scale * torch.minimum(begin, end))
    return (weight * decay * decay_mean(scale * (end - begin).abs())).sum(0)


def decayed_line(near: Tensor, far: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """What reaches the near end of a step from all along it, and what is lost of what enters it.

    The first is the mean over s in [0, 1] of (near + (far - near) s) exp(-depth s), which is far
    phi + (near - far) psi; the second, the part of what enters at the far end, is 1 - exp(-depth).
    `depth` [N, C, ...] >= 0; `near` and `far` have its shape, or one of them has one channel.
    """
    phi = decay_mean(depth)
    psi = _psi(depth, phi)
    return far * phi + (near - far) * psi, -torch.expm1(-depth)


def _psi(depth: Tensor, phi: Tensor) -> Tensor:
    """psi, given `phi`; or as the sum over k of (-`depth`)^k / (k + 2)!."""
    *others, last = (depth.new_tensor(1 / math.factorial(k + 2)) for k in range(TERMS))
    series = last.expand_as(depth)
    for factor in reversed(others):
        series = torch.addcmul(factor, depth, series, value=-1)
    thick = depth.clamp(min=SERIES_BELOW)
    return torch.where(depth < SERIES_BELOW, series, (1 - phi) / thick)
