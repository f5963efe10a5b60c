"""The light of a black body, in linear sRGB."""

from __future__ import annotations

import torch
from torch import Tensor

WHITE = 1500.0
"""The temperature of a flame [K], at which the luminance of B is 1."""
SECOND = 1.438776877e7
"""h c / k [nm K]"""
LENGTHS = 380.0, 780.0, 81
"""Wavelengths [nm] over which spectra are summed: from, to, and how many."""
LOBES = {
    "x": ((1.056, 599.8, 37.9, 31.0), (0.362, 442.0, 16.0, 26.7), (-0.065, 501.1, 20.4, 26.2)),
    "y": ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1)),
    "z": ((1.217, 437.0, 11.8, 36.0), (0.681, 459.0, 26.0, 13.8)),
}
"""Sums of Gaussians for the color matching functions of CIE 1931: height, center, and width below
and above [nm] (Wyman, Sloan and Shirley 2013, https://jcgt.org/published/0002/02/01/).
"""
SRGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
"""Red, green and blue of X, Y and Z (IEC 61966-2-1)."""


def black_body_radiance(temperature: Tensor) -> Tensor:
    """B(T) >= 0 of `temperature` [K], [3, ...]: linear sRGB, of luminance 1 at `WHITE` (E2.11).

    By Planck's law. Colors beyond sRGB, those of less than 1900 K, lose what is below 0.
    """
    first, last, count = LENGTHS
    length = torch.linspace(first, last, count, dtype=torch.float64)
    matching = torch.stack([_matching(lobes, length) for lobes in LOBES.values()])

    def tristimulus(kelvin: Tensor) -> Tensor:
        exponent = SECOND / (length * kelvin.double().clamp(min=1.0)[..., None])
        # Planck's law without its constant, divided by its exponential at 560 nm and `WHITE`.
        shift = SECOND / (560.0 * WHITE)
        spectrum = torch.exp(shift - exponent) / -torch.expm1(-exponent) * (560.0 / length) ** 5
        return torch.stack([(spectrum * curve).sum(-1) for curve in matching])

    brightness = tristimulus(torch.tensor(WHITE))[1]
    colors = torch.tensordot(torch.tensor(SRGB).double(), tristimulus(temperature), 1) / brightness
    return colors.clamp(min=0).to(temperature.dtype)


def _matching(lobes: tuple[tuple[float, ...], ...], length: Tensor) -> Tensor:
    total = torch.zeros_like(length)
    for height, center, below, above in lobes:
        width = torch.where(length < center, below, above)
        total = total + height * torch.exp(-0.5 * ((length - center) / width) ** 2)
    return total
