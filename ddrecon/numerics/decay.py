"""Integrals along rays, of what is linear between nodes and of exponential decay there.

Over depths from a to b >= a, linear in between, the mean of exp(-depth) is exp(-a) phi(b - a), with

    phi(d) = (1 - exp(-d)) / d,    psi(d) = phi + phi' = (1 - phi) / d.

Of what is emitted on such a step, (e + r (s - 1/2)) at the part s of it, e phi + r d eta leave it,
and of the mean along it e psi - r eta are its own, with

    eta(d) = (psi - phi / 2) / d.

Where d is small eta is its series: its closed form is a difference of nearly equal numbers there.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.numerics.autodiff import is_varied
from ddrecon.numerics.remember import constant

SERIES_BELOW = 0.1
"""Below this depth eta is its series."""
SERIES = [(k + 1) / (2 * math.factorial(k + 3)) for k in range(9)]
"""Coefficients of the series in -depth: the next one, and its slope, are below rounding."""


def decay_mean(depth: Tensor) -> Tensor:
    """phi(`depth`): the mean of exp(-depth s) over s in [0, 1]; `depth` >= 0, of any shape."""
    at = depth.detach()
    shifted = at + torch.finfo(at.dtype).tiny
    phi = -torch.expm1(-shifted) / shifted
    if not is_varied(depth):
        return phi
    # The second term is 0 and has the slope: so one array is kept, where autograd would keep ten.
    psi = 0.5 * phi + at * _eta(at, phi)
    return phi + (psi - phi) * (depth - at)


def decayed_sum(weight: Tensor, begin: Tensor, end: Tensor, scale: Tensor) -> Tensor:
    """Sum over segments of `weight` times the mean of exp(-depth) there, `[C, R]`.

    `scale` [C, 1] times `begin` and `end` [S, K, R] >= 0 are the depths at both ends of each of S
    segments, in either order; `weight`: [S, K or C, R]. K is 1 or C.
    """
    decay = torch.exp(-scale * torch.minimum(begin, end))
    return (weight * decay * decay_mean(scale * (end - begin).abs())).sum(0)


def decay_terms(depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """phi, psi and eta of `depth`, >= 0, of any shape."""
    phi = decay_mean(depth)
    eta = _eta(depth, phi)
    return phi, 0.5 * phi + depth * eta, eta


def _eta(depth: Tensor, phi: Tensor) -> Tensor:
    """eta, given `phi`; or as the sum over k of (-`depth`)^k (k + 1) / (2 (k + 3)!)."""
    *factors, last = constant(SERIES, depth)
    series = last.expand_as(depth)
    for factor in reversed(factors):
        series = torch.addcmul(factor, depth, series, value=-1)
    thick = depth.clamp(min=SERIES_BELOW)
    return torch.where(depth < SERIES_BELOW, series, ((1 - phi) / thick - 0.5 * phi) / thick)


@dataclass(frozen=True)
class Nodes:
    """N nodes on each of R rays.

    `origin` and unit `direction` [R, 3] of the rays, in array order; `distance` [N, R]: from the
    origin to the nodes [u].
    """

    origin: Tensor
    direction: Tensor
    distance: Tensor

    @property
    def lengths(self) -> Tensor:
        """The lengths [u] of the segments between nodes, `[N - 1, R]`."""
        return self.distance[1:] - self.distance[:-1]

    def integral(self, values: Tensor, measure: Tensor | None = None) -> Tensor:
        """The integral `[N - 1, K, R]` over each segment of what is linear between nodes.

        `values`: [N, K, R] at the nodes; `measure` [N - 1, R]: of each segment, by default its
        length.
        """
        over = self.lengths if measure is None else measure
        return 0.5 * (values[:-1] + values[1:]) * over[:, None]
