"""Light to first order in angle: radiance(w) = mean + flux . w at every cell.

Sources (Q0, Q1), diffuse light (L0, L1) and what scatters towards a camera all have this form.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

Vector = tuple[Tensor, Tensor, Tensor]
"""Components along z, y, x."""
MARGIN = 0.01
"""Radiance is held above zero by a bend that starts at this part of the sizes of its two terms."""


@dataclass(frozen=True)
class Moments:
    """`mean` [C, z, y, x], and `flux`, three tensors of that shape along z, y, x.

    `flux` is None where light's direction does not matter.
    """

    mean: Tensor
    flux: Vector | None = None

    def scaled(self, mean: Tensor | float, flux: Tensor | float) -> Moments:
        """Each moment times its own factor."""
        return Moments(
            mean * self.mean,
            None if self.flux is None else _vector(flux * component for component in self.flux),
        )

    def plus(self, other: Moments) -> Moments:
        """The sum of two lights; a flux that one of them lacks is zero there."""
        if self.flux is None or other.flux is None:
            return Moments(self.mean + other.mean, other.flux if self.flux is None else self.flux)
        return Moments(
            self.mean + other.mean,
            _vector(a + b for a, b in zip(self.flux, other.flux, strict=True)),
        )

    def along(self, direction: Vector) -> Tensor:
        """Radiance along `direction`, whose components broadcast to `[C, z, y, x]`."""
        radiance = self.mean
        for component, cosine in zip(self.flux or (), direction, strict=self.flux is not None):
            radiance = torch.addcmul(radiance, component, cosine)
        return radiance

    def positive_along(self, direction: Vector) -> Tensor:
        """Radiance r = `along`, bent to zero below m = MARGIN (|L0| + |L1 . w|).

        It is r where r >= m, m (1 + r/m)^2 / 4 from there down to -m, and 0 below. E3 is negative
        where light is more directed than two terms in angle can say; where g is not 0 so may L0 be,
        since E4's source then has either sign. Both mean darkness. Without a flux E7's M-matrix
        keeps L0 >= 0, and what a solve leaves below zero is cut off.
        """
        radiance = self.along(direction)
        if self.flux is None:
            return radiance.clamp(min=0)
        margin = MARGIN * (self.mean.abs() + (radiance - self.mean).abs())
        divisor = margin.clamp(min=1e6 * torch.finfo(margin.dtype).tiny)
        bent = margin * (1 + (radiance / divisor).clamp(-1, 1)) ** 2 / 4
        return torch.where(radiance >= margin, radiance, bent)


def _vector(components: Iterable[Tensor]) -> Vector:
    z, y, x = components
    return z, y, x


def beam_moments(radiance: Tensor, direction: Tensor, has_flux: bool) -> Moments:
    """The moments of light that all travels along `direction` w: `radiance` and `radiance` w.

    `radiance`: [C, z, y, x]; `direction`: [3] or [3, z, y, x], array order.
    """
    return Moments(
        radiance, _vector(radiance * component for component in direction) if has_flux else None
    )
