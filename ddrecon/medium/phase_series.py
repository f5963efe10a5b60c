"""Phase functions given by their moments, or by values over the angle."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.medium.phase import NEGLIGIBLE, PhaseFunction
from ddrecon.numerics.angle_table import STEPS, angle_of, look_up, with_slopes
from ddrecon.numerics.legendre import (
    COUNTS,
    gauss_legendre,
    legendre,
    legendre_at_even_angles,
    series_weights,
)

NODES = 2048
"""Of the quadrature over a table: twice as many as its steps, so that it sees its cubics."""


class _Given(PhaseFunction):
    """A phase function of which only its moments are known."""

    def peak_tail(self, degree: int, count: int) -> Tensor:
        """As many moments as there are of what a peak of part f can have.

        f is chi_(degree + 1), but not below 0, and not more than leaves a mean cosine >= 0 to the
        rest. So a function without a forward peak, as Rayleigh's, has none.
        """
        chi = self.moments(degree + count + 1)
        peak = torch.minimum(chi[:, degree + 1 : degree + 2], chi[:, 1:2]).clamp(min=0)
        tail = torch.maximum(torch.minimum(chi[:, degree + 2 :], peak), -peak)
        return torch.cat([peak, tail], 1)

    def backward_tail(self, degree: int, count: int) -> Tensor:
        return torch.zeros_like(self.moments(count))

    def length(self) -> int:
        large = self.moments(COUNTS[-1]).detach().abs().amax(0) > NEGLIGIBLE
        last = int(large.nonzero().max()) + 1
        return next(count for count in COUNTS if last <= count)


@dataclass(frozen=True, eq=False)
class Legendre(_Given):
    """The series sum of (2 l + 1) chi_l P_l(w), held at zero where it would be negative.

    `coefficients`: chi_l from l = 1 on, [n] or [3, n], n < 2048; chi_0 is 1.
    """

    NAME = "legendre"
    VARIABLES = ("coefficients",)

    coefficients: Tensor

    def value(self, cosine: Tensor) -> Tensor:
        weights = series_weights(self.moments(self.length()))
        rows, slopes = legendre_at_even_angles(STEPS, weights.shape[1])
        table = torch.stack([weights @ rows.to(weights).T, weights @ slopes.to(weights).T], -1)
        return look_up(table[..., None], angle_of(cosine))[..., 0].clamp(min=0).to(cosine.dtype)

    def moments(self, count: int) -> Tensor:
        given = self.coefficients.reshape(-1, self.coefficients.shape[-1])[:, : count - 1]
        missing = given.new_zeros(len(given), count - 1 - given.shape[1])
        return torch.cat([given.new_ones(len(given), 1), given, missing], 1)

    def length(self) -> int:
        count = self.coefficients.shape[-1] + 1
        return next((some for some in COUNTS if count <= some), COUNTS[-1])


@dataclass(frozen=True, eq=False)
class Tabulated(_Given):
    """A smooth curve through `values` at even angles from 0 to pi, divided by its integral.

    `values` >= 0: [C, steps + 1] with C = 1 or 3, of any scale. `at_even_angles` makes them from
    uneven ones (`numerics.angle_table`).
    """

    NAME = "table"

    values: Tensor

    def value(self, cosine: Tensor) -> Tensor:
        found = look_up(with_slopes(self.values), angle_of(cosine))[..., 0]
        norm = self.mean.reshape(-1, *[1] * cosine.ndim)
        return (found / norm).clamp(min=0).to(cosine.dtype)

    def moments(self, count: int) -> Tensor:
        integrals = self._integrals(count)
        return integrals / integrals[:, :1]

    @property
    def mean(self) -> Tensor:
        """The mean of the curve over the sphere, [C]."""
        return self._integrals(1)[:, 0]

    def _integrals(self, count: int) -> Tensor:
        """Half the integrals over the cosine of the curve times P_l, [C, count]."""
        angles, weights = _quadrature(count)
        curve = look_up(with_slopes(self.values), angles)[..., 0]
        return curve @ weights.to(curve)


@functools.lru_cache(maxsize=4)
@torch.inference_mode(False)
def _quadrature(count: int) -> tuple[Tensor, Tensor]:
    """Angles of Gauss's rule, and half its weights times P_l there [NODES, count]."""
    cosine, weights = gauss_legendre(NODES)
    return cosine.acos(), legendre(cosine, count) * (weights / 2)[:, None]
