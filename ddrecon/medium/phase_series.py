"""Phase functions given by values over the angle."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.medium.phase import NEGLIGIBLE, PhaseFunction, beside
from ddrecon.numerics.angle_table import angle_of, look_up, with_slopes
from ddrecon.numerics.legendre import COUNTS, gauss_legendre, legendre

NODES = 2048
"""Of the quadrature over a table: twice as many as its steps, so that it sees its cubics."""


@dataclass(frozen=True, eq=False)
class Tabulated(PhaseFunction):
    """A smooth curve through `values` at even angles from 0 to pi, over its integral (E8.2).

    `values` >= 0: [C, steps + 1] with C = 1 or 3, of any scale. `at_even_angles` makes them from
    uneven ones (`numerics.angle_table`).
    """

    NAME = "table"

    values: Tensor

    def value(self, cosine: Tensor) -> Tensor:
        curve = look_up(with_slopes(self.values), angle_of(cosine))[..., 0]
        return (curve / beside(self.mean, cosine)).clamp(min=0).to(cosine.dtype)

    def moments(self, count: int) -> Tensor:
        integrals = self._integrals(count)
        return integrals / integrals[:, :1]

    def peak_tail(self, degree: int, count: int, sign: int = 1) -> Tensor:
        """As many moments as there are of what a forward peak of part f can have.

        f is chi_(degree + 1), but not below 0, and not more than leaves a mean cosine >= 0 to the
        rest. So a function without a forward peak, as Rayleigh's, has none.
        """
        chi = self.moments(degree + count + 1)
        if sign < 0:
            return torch.zeros_like(chi[:, :count])
        peak = torch.minimum(chi[:, degree + 1 : degree + 2], chi[:, 1:2]).clamp(min=0)
        tail = torch.maximum(torch.minimum(chi[:, degree + 2 :], peak), -peak)
        return torch.cat([peak, tail], 1)

    def length(self) -> int:
        large = self.moments(COUNTS[-1]).detach().abs().amax(0) > NEGLIGIBLE
        last = int(large.nonzero().max()) + 1
        return next(count for count in COUNTS if last <= count)

    @property
    def mean(self) -> Tensor:
        """The mean of the curve over the sphere, [C]."""
        return self._integrals(1)[:, 0]

    def _integrals(self, count: int) -> Tensor:
        """Half the integrals over the cosine of the curve times P_l, [C, count]."""
        angles, weights = _quadrature(count)
        curve = look_up(with_slopes(self.values), angles.to(self.values.device))[..., 0]
        return curve @ weights.to(curve)


@functools.lru_cache(maxsize=4)
@torch.inference_mode(False)
def _quadrature(count: int) -> tuple[Tensor, Tensor]:
    """Angles of Gauss's rule, and half its weights times P_l there [NODES, count]."""
    cosine, weights = gauss_legendre(NODES)
    return cosine.acos(), legendre(cosine, count) * (weights / 2)[:, None]
