"""Light by its moments in angle: radiance(w) = mean + flux . w + ... at every cell.

Sources (Q0, Q1), diffuse light (L0, L1) and what scatters towards a camera all have this form.
Transport rounds go on to higher degrees (docs/theory.md E2.8).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ddrecon.numerics.harmonics import (
    count_harmonics,
    degrees_on,
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
    Where all light goes one way, `beam` may stand for `higher`: B [C, z, y, x] and factors
    [K, C or 1] by which all phi_k are B.
    """

    mean: Tensor
    flux: Vector | None = None
    higher: Tensor | None = None
    beam: tuple[Tensor, Tensor] | None = None

    def spelled(self) -> Moments:
        """The same light with all of `higher`, and no `beam`."""
        if self.beam is None:
            return self
        radiance, factors = self.beam
        return Moments(self.mean, self.flux, factors[4:, :, None, None, None] * radiance)

    @staticmethod
    def of_harmonics(values: Tensor) -> Moments:
        """The light whose moments phi_k are `values` [K, C, z, y, x] (E2.8)."""
        if len(values) == 1:
            return Moments(values[0])
        y, z, x = (_FIRST * values[k] for k in (1, 2, 3))
        return Moments(values[0], (z, y, x), values[4:] if len(values) > 4 else None)

    @staticmethod
    def of_sums(sums: Tensor) -> Moments:
        """The light whose mean, flux along z, y, x and moments of degree 2 and more are `sums`."""
        if len(sums) == 1:
            return Moments(sums[0])
        # Cut, not indexed: on the way back this is put together once.
        first, higher = sums.split([4, len(sums) - 4])
        mean, z, y, x = first.unbind()
        return Moments(mean, (z, y, x), higher if len(higher) else None)

    def harmonics(self, degree: int) -> Tensor:
        """All phi_k up to `degree` [K, C, z, y, x] (E2.8); those that are missing are zero."""
        parts = [self.mean[None]]
        if degree > 0:
            if self.flux is None:
                parts.append(torch.zeros_like(self.mean).expand(3, *self.mean.shape))
            else:
                z, y, x = self.flux
                parts.append(torch.stack([y, z, x]) / _FIRST)
        higher = self.spelled().higher
        if higher is not None:
            parts.append(higher.expand(-1, *self.mean.shape))
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
            None if (of_light := self.spelled().higher) is None else higher * of_light,
        )

    def mapped(self, function: Callable[[Tensor], Tensor]) -> Moments:
        """The same with what `function` makes of each of its tensors."""
        flux, higher = self.flux, self.spelled().higher
        return Moments(
            function(self.mean),
            None if flux is None else _vector(map(function, flux)),
            None if higher is None else function(higher),
        )

    def weighted(self, factors: Tensor) -> Moments:
        """Moments of degree l times `factors`[l], which broadcast to `[C, z, y, x]`."""
        flux = factors[1] if self.flux is not None else 1.0
        if self.beam is not None and factors[0, 0].numel() == 1:
            radiance, of_beam = self.beam
            first = replace(self, beam=None).scaled(factors[0], flux)
            return replace(first, beam=(radiance, _by_harmonic(factors).flatten(1) * of_beam))
        light = self.spelled()
        higher = 1.0 if light.higher is None else _by_harmonic(factors)[4:]
        return light.scaled(factors[0], flux, higher)

    def plus(self, other: Moments) -> Moments:
        """The sum of two lights; what one of them lacks is zero there."""
        own, others = self.spelled().higher, other.spelled().higher
        higher = others if own is None else own
        if own is not None and others is not None:
            higher = own + others
        return Moments(self.mean + other.mean, add_vectors(self.flux, other.flux), higher)

    def toward(self, other: Moments, part: Tensor) -> Moments:
        """That `part` of the way to `other`, which has all this has; what this lacks is zero there.

        One pass over all moments, which are many.
        """

        def go(one: Tensor | None, other: Tensor) -> Tensor:
            return part * other if one is None else torch.lerp(one, other, part)

        own, flux, higher = self.flux or (None,) * 3, other.flux, other.higher
        return Moments(
            go(self.mean, other.mean),
            None if flux is None else _vector(map(go, own, flux)),
            None if higher is None else go(self.higher, higher),
        )

    def along(self, direction: Vector) -> Tensor:
        """Radiance along `direction`, whose components broadcast to `[C, z, y, x]`."""
        radiance = self.mean
        for component, cosine in zip(self.flux or (), direction, strict=self.flux is not None):
            radiance = torch.addcmul(radiance, component, cosine)
        higher = self.spelled().higher
        if higher is not None:
            degree = math.isqrt(len(higher) + 4) - 1
            for k, value in each_harmonic(*direction, degree):
                if k >= 4:
                    radiance = torch.addcmul(radiance, higher[k - 4], value)
        return radiance

    def positive_along(self, direction: Vector, more: Tensor | None = None) -> Tensor:
        """Radiance `along` + `more`, `floored`."""
        radiance = self.along(direction)
        return self.floored(radiance if more is None else radiance + more)

    def floored(self, radiance: Tensor) -> Tensor:
        """`radiance` r of this light [..., C, z, y, x], floored below m = MARGIN (|L0| + |r - L0|).

        It is r where r >= m, m (1 + r/m)^2 / 4 from there down to -m, and 0 below. E2.3 is negative
        where light is more directed than two terms in angle can say; where g is not 0 so may L0 be,
        since E2.4's source then has either sign. Both mean darkness. Without a flux E2.7's M-matrix
        keeps L0 >= 0, and what a solve leaves below zero is cut off.
        """
        if self.flux is None:
            return radiance.clamp(min=0)
        margin = MARGIN * (self.mean.abs() + (radiance - self.mean).abs())
        divisor = margin.clamp(min=1e6 * torch.finfo(margin.dtype).tiny)
        floored = margin * (1 + (radiance / divisor).clamp(-1, 1)) ** 2 / 4
        return torch.where(radiance >= margin, radiance, floored)


def _by_harmonic(factors: Tensor) -> Tensor:
    """`factors` [L + 1, ...] of degrees, of each harmonic [K, ...]."""
    return factors.index_select(0, degrees_on(factors.device, len(factors) - 1))


def add_vectors(one: Vector | None, other: Vector | None) -> Vector | None:
    """The sum of two vectors; None is zero."""
    if one is None or other is None:
        return one or other
    return _vector(a + b for a, b in zip(one, other, strict=True))


def _vector(components: Iterable[Tensor]) -> Vector:
    z, y, x = components
    return z, y, x


_harmonics_of = remember(harmonics)


def beam_moments(radiance: Tensor, direction: Tensor, degree: int) -> Moments:
    """The moments up to `degree` of light that all travels along `direction` w.

    They are `radiance` times Y_k(w) (E2.8). `radiance`: [C, z, y, x]; `direction`: [3] or
    [3, z, y, x], array order.
    """
    if degree == 0:
        return Moments(radiance)
    z, y, x = direction
    higher = beam = None
    if degree > 1 and direction.ndim == 1:
        beam = radiance, _harmonics_of(direction, degree)[:, None]
    elif degree > 1:
        values = dict(each_harmonic(z, y, x, degree))
        higher = torch.stack([values[k] * radiance for k in range(4, count_harmonics(degree))])
    return Moments(radiance, (3 * z * radiance, 3 * y * radiance, 3 * x * radiance), higher, beam)
