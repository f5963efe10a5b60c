"""The Henyey-Greenstein phase function and the delta-Eddington scaling of its forward peak.

Phase functions are normalized to 4 pi over the sphere, as in docs/theory.md E2.
"""

from __future__ import annotations

from torch import Tensor


def henyey_greenstein(cosine: Tensor, g: Tensor) -> Tensor:
    """p(cosine) = (1 - g^2) / (1 + g^2 - 2 g cosine)^(3/2), normalized to 4 pi.

    `cosine`: cosine between the directions of travel before and after scattering, in [-1, 1]; `g`: mean cosine, scalar in
    (-1, 1). Source: Henyey and Greenstein 1941, doi:10.1086/144246.
    """
    return (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5


def forward_fraction(g: Tensor) -> Tensor:
    """The fraction f of scattering that delta-Eddington scaling treats as not scattered: g^2 for g > 0, else 0.

    A phase function with g <= 0 has no forward peak to remove; f and its derivative are continuous at g = 0.
    Source: Joseph, Wiscombe, Weinman 1976, doi:10.1175/1520-0469(1976)033<2452:TDEAFR>2.0.CO;2.
    """
    return g.clamp(min=0) ** 2


def scaled_mean_cosine(g: Tensor) -> Tensor:
    """The mean cosine g' = (g - f) / (1 - f) of what remains: g / (1 + g) for g > 0, else g."""
    return g / (1 + g.clamp(min=0))
