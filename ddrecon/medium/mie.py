"""The phase function of spherical droplets by Mie's theory (extra `mie`)."""

from __future__ import annotations

import math

import numpy as np

from ddrecon.extras import load_extra
from ddrecon.numerics.angle_table import STEPS

RADII = 400
"""Of the quadrature over sizes: so many that the ripples of single spheres cancel."""
NEGLIGIBLE = 1e-7
"""Sizes are left out that cover less area than this part of what the commonest cover."""


def scatter_droplets(
    wavelength: float, refractive_index: float, effective_radius: float, effective_variance: float
) -> np.ndarray:
    """Values [STEPS + 1] of the phase function at even angles from 0 to pi, of any scale.

    Radii r follow the gamma distribution r^((1 - 3 b) / b) exp(-r / (a b)), E8.3, of Hansen and
    Travis 1974 (doi:10.1007/BF00168069), with `effective_radius` a, `effective_variance` b < 0.5.
    `wavelength` and radii in the same unit. Raises MissingExtraError without miepython.
    """
    miepython = load_extra("miepython", "a phase function by Mie's theory")
    radii, counts = _radii(effective_radius, effective_variance)
    circumferences = 2 * math.pi * radii / wavelength
    series = [miepython.coefficients(refractive_index, size) for size in circumferences]
    terms = max(len(a) for a, _ in series)
    order = np.arange(1, terms + 1)
    factor = (2 * order + 1) / (order * (order + 1))
    a, b = (
        factor * np.stack([np.pad(numbers, (0, terms - len(numbers))) for numbers in coefficients])
        for coefficients in zip(*series, strict=True)
    )
    pi, tau = _angular_functions(np.cos(np.linspace(0, math.pi, STEPS + 1)), terms)
    # Amplitudes S1 and S2 of each size [RADII, STEPS + 1]; unpolarized light has their mean power.
    power = np.abs(a @ pi + b @ tau) ** 2 + np.abs(a @ tau + b @ pi) ** 2
    values: np.ndarray = counts @ power
    return values


def _radii(effective_radius: float, effective_variance: float) -> tuple[np.ndarray, np.ndarray]:
    """Evenly spaced radii [RADII], and how many droplets there are of each."""
    radii = effective_radius * np.linspace(0, 1 + 40 * math.sqrt(effective_variance), 20001)[1:]
    exponent = (1 - 3 * effective_variance) / effective_variance

    def logarithm(radii: np.ndarray, power: float) -> np.ndarray:
        return (exponent + power) * np.log(radii) - radii / (effective_radius * effective_variance)

    area = logarithm(radii, 2)
    covered = radii[area > area.max() + math.log(NEGLIGIBLE)]
    chosen = np.linspace(covered[0], covered[-1], RADII)
    number = logarithm(chosen, 0)
    return chosen, np.exp(number - number.max())


def _angular_functions(cosine: np.ndarray, terms: int) -> tuple[np.ndarray, np.ndarray]:
    """pi_n and tau_n of Mie's series at `cosine` [N], both [terms, N].

    Source: Bohren and Huffman 1983, equation 4.47.
    """
    pi, tau = np.empty((terms, len(cosine))), np.empty((terms, len(cosine)))
    previous, current = np.zeros_like(cosine), np.ones_like(cosine)
    for n in range(1, terms + 1):
        pi[n - 1] = current
        tau[n - 1] = n * cosine * current - (n + 1) * previous
        following = ((2 * n + 1) * cosine * current - (n + 1) * previous) / n
        previous, current = current, following
    return pi, tau
