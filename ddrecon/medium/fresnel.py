"""Smooth flat faces between a medium of some refractive index and empty space (E2.13).

By Fresnel's equations of light that is not polarized. What faces do to diffuse light are moments of
their transmittance over directions.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from ddrecon.numerics.quadrature import sphere_quadrature

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
