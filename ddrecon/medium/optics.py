"""What optics says of flames, droplets and faces: by Planck, Mie and Fresnel."""

import functools
import math

import numpy as np
import torch
from torch import Tensor

from ddrecon.extras import load_extra
from ddrecon.numerics.series import STEPS
from ddrecon.numerics.sphere import sphere_quadrature

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


NODES = 64
"""Of Gauss's rule over the cosine outside, in which transmittance is smooth."""


def reflectance(inside: Tensor, index: float) -> Tensor:
    """The part of light reflected that meets a face at the cosine `inside` > 0, on the inner side.

    That is 1 beyond the critical angle. Light from outside that goes on at `inside` has the same.
    """
    square = 1 - index**2 * (1 - inside**2)
    is_total = square <= 0
    outside = torch.where(is_total, 1, square).sqrt()
    across = (index * inside - outside) / (index * inside + outside)
    along = (index * outside - inside) / (index * outside + inside)
    return torch.where(is_total, 1, 0.5 * (across**2 + along**2))


def refract(direction: Tensor, normal: Tensor, ratio: float) -> Tensor:
    """Unit `direction` [..., 3] beyond a face, by Snell's law.

    `normal` has a 1 for the face's axis, else 0; `ratio` is the index before it over that beyond.
    Of light that is reflected totally it is along the face.
    """
    along = ratio * direction * (1 - normal)
    square = 1 - along.square().sum(-1, keepdim=True)
    is_total = square <= 0
    cosine = torch.where(is_total, 1, square).sqrt()
    beyond = along + normal * direction.sign() * cosine
    return torch.where(is_total, direction * (1 - normal), beyond)


@functools.cache
def transmitted_moments(index: float) -> tuple[float, float]:
    """2 int T m dm and 3 int T m^2 dm over cosines m inside, T = 1 - R (Haskell et al. 1994).

    The first is what faces let pass of even light. With m dm = m' dm' / n^2, m' being outside.
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    outside, weight = (nodes + 1) / 2, weights / 2 * (nodes + 1) / 2 / index**2
    inside = np.sqrt(1 - (1 - outside**2) / index**2)
    passed = weight * (1 - reflectance(torch.from_numpy(inside), index).numpy())
    return float(2 * passed.sum()), float(3 * (passed * inside).sum())


def face_resistance(index: float) -> float:
    """L0 over F on a face (E2.13): 2 without refraction."""
    if index == 1:
        return 2.0
    first, second = transmitted_moments(index)
    return 2 * (2 - second) / first


@functools.cache
@torch.inference_mode(False)
def quadrature_reflectances(index: float, count: int) -> Tensor:
    """What faces across z, y and x reflect of the light along each of `count` directions, [N, 3].

    Each direction stands for a range of cosines as large as its weight, and has their mean
    transmittance, times what makes the first of `transmitted_moments` exact, but at most 1.
    """
    points, weights = sphere_quadrature(torch.zeros((), dtype=torch.float64), count)
    cosines = points.abs().numpy().round(12)
    levels, level = np.unique(cosines[:, 0], return_inverse=True)
    share = np.bincount(level, weights.numpy())
    nodes, gauss = np.polynomial.legendre.leggauss(NODES)
    place = (share.cumsum() - share)[:, None] + share[:, None] * (nodes + 1) / 2
    passed = 1 - reflectance(torch.from_numpy(place), index).numpy()
    mean = (passed * place) @ gauss / (place @ gauss)
    entering = transmitted_moments(index)[0] * (share * levels).sum()
    reflected = 1 - np.minimum(entering / (share * levels * mean).sum() * mean, 1)
    return torch.from_numpy(reflected[np.searchsorted(levels, cosines)])
