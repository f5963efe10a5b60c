"""Real spherical harmonics, as polynomials in a vector's components.

Y_k with k = l^2 + l + m is of degree l and order m, from -l to l; the polar axis is z. The mean
square of each over the sphere is 1, so the sum over m of Y_lm(a) Y_lm(b) is (2l + 1) P_l(a . b),
with Legendre's polynomials P_l. For l = 1 they are sqrt(3) times y, z and x.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor


def count_harmonics(degree: int) -> int:
    """How many harmonics there are up to `degree`, (L + 1)^2."""
    return (degree + 1) ** 2


def harmonics(direction: Tensor, degree: int) -> Tensor:
    """Y_k of `direction` [..., 3] (array order), `[K, ...]` with all K up to `degree`.

    Exact where it is unit. Of a shorter vector v they are |v|^l Y_k(v / |v|): they fade as light
    that comes from everywhere.
    """
    z, y, x = direction.unbind(-1)
    values = dict(each_harmonic(z, y, x, degree))
    return torch.stack(torch.broadcast_tensors(*(values[k] for k in range(len(values)))))


def each_harmonic(z: Tensor, y: Tensor, x: Tensor, degree: int) -> Iterator[tuple[int, Tensor]]:
    """Each k with Y_k of the vector z, y, x, as of `harmonics`, one at a time.

    They come order by order; components broadcast, and a harmonic may be smaller than what they
    broadcast to.
    """
    square = z * z + y * y + x * x
    # the real and the imaginary part of (x + i y)^m
    cosine, sine = torch.ones_like(z), torch.zeros_like(z)
    for m in range(degree + 1):
        # Legendre's functions of order m without their sine^m, times |v|^(l - m), from l = m on
        legendre, before = torch.full_like(z, float(math.prod(range(1, 2 * m, 2)))), None
        for ell in range(m, degree + 1):
            if ell > m:
                after = (2 * ell - 1) * z * legendre
                if before is not None:
                    after = after - (ell + m - 1) * square * before
                legendre, before = after / (ell - m), legendre
            value = norm(ell, m) * legendre
            yield ell * ell + ell + m, value * cosine if m else value
            if m:
                yield ell * ell + ell - m, value * sine
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine


def norm(ell: int, m: int) -> float:
    """What makes the mean square of a harmonic 1."""
    orders = 2 if m else 1
    return math.sqrt(orders * (2 * ell + 1) * math.factorial(ell - m) / math.factorial(ell + m))
