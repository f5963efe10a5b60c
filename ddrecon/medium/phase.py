"""The Henyey-Greenstein phase function and the delta-Eddington scaling of its forward peak.

Phase functions are normalized to 4 pi over the sphere, as in docs/theory.md E2.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ddrecon.engine import current_engine
from ddrecon.numerics.autodiff import is_forward, is_varied
from ddrecon.numerics.chebyshev import evaluate_positive, fit_chebyshev
from ddrecon.numerics.decay import decay_mean


def henyey_greenstein(cosine: Tensor, g: Tensor) -> Tensor:
    """p(cosine) = (1 - g^2) / (1 + g^2 - 2 g cosine)^(3/2), normalized to 4 pi.

    `cosine`: cosine between the directions of travel before and after scattering, in [-1, 1]; `g`:
    mean cosine, scalar in (-1, 1). Source: Henyey and Greenstein 1941, doi:10.1086/144246.
    """
    return (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5


def forward_fraction(g: Tensor) -> Tensor:
    """The fraction f of scattering that counts as not scattered: g^2 for g > 0, else 0.

    A phase function with g <= 0 has no forward peak to remove; f and its derivative are continuous
    at g = 0. Source: delta-Eddington scaling, Joseph, Wiscombe, Weinman 1976,
    doi:10.1175/1520-0469(1976)033<2452:TDEAFR>2.0.CO;2.
    """
    return g.clamp(min=0) ** 2


def scaled_mean_cosine(g: Tensor) -> Tensor:
    """The mean cosine g' = (g - f) / (1 - f) of what remains: g / (1 + g) for g > 0, else g."""
    return g / (1 + g.clamp(min=0))


def peaked_phase(depth: Tensor, cosine: Tensor, g: Tensor) -> Tensor:
    """S (docs/theory.md E13), >= 0: what replaces the phase function from a beam into a view ray.

    It holds light scattered once, and light that the forward peak alone scattered. `depth` x >= 0:
    f times the optical depth of scattering from where the light enters, by the point where it
    turns, to where the view ray leaves; at 0 this is `henyey_greenstein`. `cosine`: as there,
    broadcast against `depth`; `g` >= 0, scalar. It is 0 where it would be negative, since
    scattering without its peak has only two moments.
    """
    return _signed_peaked_phase(depth, cosine, g).clamp(min=0)


def peaked_phase_along(depth: Tensor, cosine: Tensor, g: Tensor) -> Tensor:
    """`peaked_phase` at `depth` [N, C, R] along R rays, each with one `cosine` [R], by polynomials.

    Exact at depth 0; elsewhere off by at most 0.007 up to g = 0.95, relative to the function's
    value or to 1 where that is less.
    """
    return evaluate_positive(fit_peaked_phase(cosine, g), depth)


def fit_peaked_phase(cosine: Tensor, g: Tensor) -> Tensor:
    """The polynomials [COEFFICIENTS, R] that stand for `peaked_phase` at each `cosine` [R]."""
    if current_engine() == "warp" and not (is_varied(cosine) or is_varied(g) or is_forward()):
        from ddrecon.medium.fused import peak as fused

        return fused.fit_peaked_phase(cosine, g)

    def along_depth(depths: Tensor) -> Tensor:
        return _signed_peaked_phase(depths, cosine.double(), g.double())

    return fit_chebyshev(along_depth, cosine)


def _signed_peaked_phase(depth: Tensor, cosine: Tensor, g: Tensor) -> Tensor:
    """S of E13 before it is held at zero."""
    fraction = forward_fraction(g)
    # phi(x), the part of the peak's light that turns here.
    turned = decay_mean(depth)
    # h(x) of E15, written as g exp(-x (1 - g)) phi(g x) / phi(x): nothing cancels, and h(0) = g.
    spread = g * torch.exp((g - 1) * depth) * decay_mean(g * depth) / turned
    # (1 - f) p', what scatters without its peak.
    without_peak = (1 - fraction) * (1 + 3 * scaled_mean_cosine(g) * cosine)
    return without_peak + fraction * turned * _spread_peak(spread, cosine)


def _spread_peak(spread: Tensor, cosine: Tensor) -> Tensor:
    """q_h of E16: the forward peak, whose moments are 1, 1, 1, h, h^2, ... with h = `spread`.

    q_h = (p_h - 1 - 3 h w) / h^2 + 1 + 3 w, where w is the `cosine` and p_h the Henyey-Greenstein
    function. Written so that nothing cancels at small h ("Without cancellation" beside E13 in
    docs/theory.md has every step).
    """
    # With a = h - 2 w and r = sqrt(1 + h a): p_h = (1 - h^2) / r^3.
    away = spread - 2 * cosine
    root = (1 + spread * away).sqrt()
    # C in 1 / r^3 = 1 - (3/2) h a + (h a)^2 C: since h a = r^2 - 1,
    # C = (1 - (5/2) r^3 + (3/2) r^5) / (r^3 (r^2 - 1)^2), where (r - 1)^2 is divided out.
    curvature = (1 + root * (2 + root * (3 + 1.5 * root))) / (root**3 * (root + 1) ** 2)
    # (3/2) h a = (3/2) h^2 - 3 h w, so the terms 1 + 3 h w cancel by algebra, and all that is left
    # holds h^2: q_h = 3 w - 3/2 + (3/2) h a + (1 - h^2) a^2 C.
    return 3 * cosine - 1.5 + 1.5 * spread * away + (1 - spread * spread) * away * away * curvature
