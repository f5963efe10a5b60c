"""Light by its moments in angle: radiance(w) = mean + flux . w + ... at every cell.

Sources (Q0, Q1), diffuse light (L0, L1) and what scatters towards a camera all have this form.
Transport rounds go on to higher degrees (docs/theory.md E17).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from ddrecon.numerics.harmonics import (
    count_harmonics,
    degrees_of_harmonics,
    each_harmonic,
    harmonics,
)
from ddrecon.numerics.remember import remember

Vector = tuple[Tensor, Tensor, Tensor]
"""Components along z, y, x."""
_FIRST = 3**0.5
"""The harmonics of degree 1 are so many times the vector's components."""
MARGIN = 0.01
"""Radiance is held above zero by a bend that starts at this part of the sizes of its two terms."""


@dataclass(frozen=True)
class Moments:
    """`mean` [C, z, y, x]; `flux`, three such tensors along z, y, x; and `higher` [K - 4, C, ...].

    `higher` are the moments phi_k of degree 2 and more: radiance(w) holds the sum of Y_k(w) phi_k.
    `flux` is None where light's direction does not matter, `higher` where two moments are kept.
    """

    mean: Tensor
    flux: Vector | None = None
    higher: Tensor | None = None

    @staticmethod
    def of_harmonics(values: Tensor) -> Moments:
        """The light whose moments phi_k are `values` [K, C, z, y, x] (E17)."""
        if len(values) == 1:
            return Moments(values[0])
        y, z, x = (_FIRST * values[k] for k in (1, 2, 3))
        return Moments(values[0], (z, y, x), values[4:] if len(values) > 4 else None)

    def harmonics(self, degree: int) -> Tensor:
        """All phi_k up to `degree` [K, C, z, y, x] (E17); those that are missing are zero."""
        parts = [self.mean[None]]
        if degree > 0:
            if self.flux is None:
                parts.append(torch.zeros_like(self.mean).expand(3, *self.mean.shape))
            else:
                z, y, x = self.flux
                parts.append(torch.stack([y, z, x]) / _FIRST)
        if self.higher is not None:
            parts.append(self.higher)
        elif degree > 1:
            missing = count_harmonics(degree) - 4
            parts.append(torch.zeros_like(self.mean).expand(missing, *self.mean.shape))
        return torch.cat(parts) if len(parts) > 1 else parts[0]

    def scaled(
        self, mean: Tensor | float, flux: Tensor | float, higher: Tensor | float = 1.0
    ) -> Moments:
        """Moments of each degree times a factor of their own; `higher`: one, or one for each."""
        return Moments(
            mean * self.mean,
            None if self.flux is None else _vector(flux * component for component in self.flux),
            None if self.higher is None else higher * self.higher,
        )

    def weighted(self, factors: Tensor) -> Moments:
        """Moments of degree l times `factors`[l], which broadcast to `[C, z, y, x]`."""
        higher: Tensor | float = 1.0
        if self.higher is not None:
            higher = factors[list(degrees_of_harmonics(len(factors) - 1)[4:])]
        return self.scaled(factors[0], factors[1] if self.flux is not None else 1.0, higher)

    def plus(self, other: Moments) -> Moments:
        """The sum of two lights; what one of them lacks is zero there."""
        higher = other.higher if self.higher is None else self.higher
        if self.higher is not None and other.higher is not None:
            higher = self.higher + other.higher
        return Moments(self.mean + other.mean, add_vectors(self.flux, other.flux), higher)

    def along(self, direction: Vector) -> Tensor:
        """Radiance along `direction`, whose components broadcast to `[C, z, y, x]`."""
        radiance = self.mean
        for component, cosine in zip(self.flux or (), direction, strict=self.flux is not None):
            radiance = torch.addcmul(radiance, component, cosine)
        if self.higher is not None:
            degree = math.isqrt(len(self.higher) + 4) - 1
            for k, value in each_harmonic(*direction, degree):
                if k >= 4:
                    radiance = torch.addcmul(radiance, self.higher[k - 4], value)
        return radiance

    def positive_along(self, direction: Vector, more: Tensor | None = None) -> Tensor:
        """Radiance r = `along` + `more`, bent to zero below m = MARGIN (|L0| + |r - L0|).

        It is r where r >= m, m (1 + r/m)^2 / 4 from there down to -m, and 0 below. E3 is negative
        where light is more directed than two terms in angle can say; where g is not 0 so may L0 be,
        since E4's source then has either sign. Both mean darkness. Without a flux E7's M-matrix
        keeps L0 >= 0, and what a solve leaves below zero is cut off.
        """
        radiance = self.along(direction)
        if self.flux is None:
            return radiance.clamp(min=0)
        if more is not None:
            radiance = radiance + more
        margin = MARGIN * (self.mean.abs() + (radiance - self.mean).abs())
        divisor = margin.clamp(min=1e6 * torch.finfo(margin.dtype).tiny)
        bent = margin * (1 + (radiance / divisor).clamp(-1, 1)) ** 2 / 4
        return torch.where(radiance >= margin, radiance, bent)


def add_vectors(one: Vector | None, other: Vector | None) -> Vector | None:
    """The sum of two vectors; None is zero."""
    if one is None or other is None:
        return one or other
    return _vector(a + b for a, b in zip(one, other, strict=True))


def _vector(components: Iterable[Tensor]) -> Vector:
    z, y, x = components
    return z, y, x


@remember
def _harmonics_of(direction: Tensor, degree: int) -> Tensor:
    return harmonics(direction, degree)


def beam_moments(radiance: Tensor, direction: Tensor, degree: int) -> Moments:
    """The moments up to `degree` of light that all travels along `direction` w.

    They are `radiance` times Y_k(w) (E17). `radiance`: [C, z, y, x]; `direction`: [3] or
    [3, z, y, x], array order.
    """
    if degree == 0:
        return Moments(radiance)
    z, y, x = direction
    higher = None
    if degree > 1 and direction.ndim == 1:
        higher = _harmonics_of(direction, degree)[4:].view(-1, 1, 1, 1, 1) * radiance
    elif degree > 1:
        values = dict(each_harmonic(z, y, x, degree))
        higher = torch.stack([values[k] * radiance for k in range(4, count_harmonics(degree))])
    return Moments(radiance, (3 * z * radiance, 3 * y * radiance, 3 * x * radiance), higher)
