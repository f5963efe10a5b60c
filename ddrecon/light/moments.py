"""Light in angle: phi [K, C, z, y, x], its spherical-harmonics moments (docs/theory.md E2.8).

radiance(w) is the sum over k of Y_k(w) phi_k, with the harmonics of `numerics/sphere.py`, whose
mean square over the sphere is 1; up to degree L there are K = (L + 1)^2. So phi[0] is L0, the mean
over the sphere, and sqrt(3) phi[1:4] is the flux L1, along y, z and x. Sources (Q0, Q1, ...),
diffuse light, and what scatters towards a camera all have this form. K is 1 where light's direction
does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ddrecon.numerics.remember import remember
from ddrecon.numerics.sphere import count_harmonics, each_harmonic, harmonics

_ROOT = 3**0.5
_AXES = 1, 0, 2
"""Which of the harmonics of degree 1 are along z, y and x; it is its own inverse."""
Cut = tuple[Tensor, Tensor]
"""Moments of degrees 0 and 1 [1 or 4, ...], as diffusion has them, and those of higher degree."""
MARGIN = 0.01
"""Radiance is held above zero by a bend that starts at this part of the sizes of its two terms."""


def flux_along_axes(first: Tensor | Sequence[Tensor]) -> list[Tensor]:
    """The flux along z, y and x, of light whose moments of degree 1 are `first` [3, ...]."""
    return [_ROOT * first[k] for k in _AXES]


def moments_of_flux(flux: Sequence[Tensor]) -> Tensor:
    """The moments of degree 1 [3, ...] of a `flux` along z, y and x."""
    return torch.stack([flux[axis] for axis in _AXES]) / _ROOT


def cut(phi: Tensor) -> Cut:
    """The moments `phi` of degrees 0 and 1, and those of higher degree."""
    if len(phi) <= 4:
        return phi, phi.detach()[:0]
    # Cut, not indexed: on the way back this is put together once.
    low, high = phi.split([4, len(phi) - 4])
    return low, high


def join(moments: Cut) -> Tensor:
    """All moments of a `cut`."""
    low, high = moments
    return torch.cat([low, high]) if len(high) else low


def mean_and_first(low: Tensor) -> tuple[Tensor, Tensor | None]:
    """The mean [...] of `low` moments [1 or 4, ...], and those of degree 1 [3, ...], if any."""
    mean, first = low.split([1, len(low) - 1])
    return mean[0], first if len(first) else None


def fill(phi: Tensor, degree: int) -> Tensor:
    """All moments up to `degree`; those that `phi` lacks are zero."""
    missing = count_harmonics(degree) - len(phi)
    return torch.cat([phi, phi.new_zeros(missing, *phi.shape[1:])]) if missing > 0 else phi


def add(phi: Tensor, more: Tensor) -> Tensor:
    """The light of both; moments that one of them lacks are zero there."""
    few, many = sorted((phi, more), key=len)
    if len(few) == len(many):
        return phi + more
    low, high = many.split([len(few), len(many) - len(few)])
    total = low + few
    return torch.cat([total, high.expand(-1, *total.shape[1:])])


def weigh(phi: Tensor, factors: Tensor) -> Tensor:
    """Moments of degree l times `factors`[l], which broadcast to `[C, z, y, x]`."""
    return by_harmonic(factors, math.isqrt(len(phi) - 1)) * phi


def by_harmonic(factors: Tensor, degree: int) -> Tensor:
    """`factors` [L + 1, ...] of degrees, of each harmonic up to `degree`, [K, ...]."""
    # Put together, not indexed: sums on the way back have a fixed order.
    return torch.cat(
        [factors[ell].expand(2 * ell + 1, *factors.shape[1:]) for ell in range(degree + 1)]
    )


_harmonics_of = remember(harmonics)


def beam_moments(radiance: Tensor, direction: Tensor, degree: int) -> Tensor:
    """phi up to `degree` of light that all travels along w: `radiance` times Y_k(w).

    `radiance`: [C, z, y, x]; `direction`: [3] or [z, y, x, 3], array order.
    """
    if direction.ndim == 1:
        return _harmonics_of(direction, degree).view(-1, 1, 1, 1, 1) * radiance
    return harmonics(direction, degree)[:, None] * radiance


def radiance_along(phi: Tensor, direction: Sequence[Tensor], more: Tensor | None = None) -> Tensor:
    """The radiance [C, z, y, x] >= 0 of `phi` along `direction`, with `more` besides: `floored`.

    `direction`: unit, its components along z, y and x broadcast to `[C, z, y, x]`.
    """
    # Cut, not indexed: on the way back this is put together once.
    moments, (z, y, x) = phi.unbind(), direction
    radiance = moments[0] if more is None else moments[0] + more
    for k, value in each_harmonic(z, y, x, math.isqrt(len(phi)) - 1):
        if k > 0:
            radiance = torch.addcmul(radiance, moments[k], value)
    return floored(radiance, moments[0], is_directed=len(phi) > 1)


def floored(radiance: Tensor, mean: Tensor, is_directed: bool) -> Tensor:
    """`radiance` r [..., C, z, y, x], floored below m = MARGIN (|L0| + |r - L0|), L0 its `mean`.

    It is r where r >= m, m (1 + r/m)^2 / 4 from there down to -m, and 0 below. E2.3 is negative
    where light is more directed than two terms in angle can say; where g is not 0 so may L0 be,
    since E2.4's source then has either sign. Both mean darkness. Where light is not `is_directed`
    E2.7's M-matrix keeps L0 >= 0, and what a solve leaves below zero is cut off.
    """
    if not is_directed:
        return radiance.clamp(min=0)
    margin = MARGIN * (mean.abs() + (radiance - mean).abs())
    divisor = margin.clamp(min=1e6 * torch.finfo(margin.dtype).tiny)
    bent = margin * (1 + (radiance / divisor).clamp(-1, 1)) ** 2 / 4
    return torch.where(radiance >= margin, radiance, bent)
