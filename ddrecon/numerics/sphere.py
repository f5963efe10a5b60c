"""Functions and integrals over the sphere.

Real spherical harmonics are polynomials in a vector's components. Y_k with k = l^2 + l + m is of
degree l and order m, from -l to l; the polar axis is z. The mean square of each over the sphere is
1, so the sum over m of Y_lm(a) Y_lm(b) is (2l + 1) P_l(a . b), with Legendre's polynomials P_l. For
l = 1 they are sqrt(3) times y, z and x.

Directions and weights that integrate over the sphere are Lebedev's rules of 26 and 50 points and
three more. They are exact for polynomials up to some degree, and symmetric under every rotation and
reflection of the cube, so no axis of the grid is preferred. Sources: Lebedev 1975,
doi:10.1016/0041-5553(75)90133-0, and 1976, doi:10.1016/0041-5553(76)90100-2. That of 18 points
follows from the means of x^4 and of x^2 y^2 alone.

Light at a face differs from side to side, so sweeps want integrals over half the sphere as well, of
which Lebedev's rules lack 11, 8 and 1 percent of |x|. That of 44 points has the mean of |x|, and
those of x^4 and x^2 y^2 z^2. That of 96 points, none of which lies within a face, has the means of
x^4, x^6, |x|, |x y|, |x|^3 and |x|^5.
"""

import math
from collections.abc import Iterator
from itertools import permutations, product

import torch
from torch import Tensor

_ORBITS = {
    18: (((0.0, 0.0, 1.0), 1 / 30), ((0.0, 0.5**0.5, 0.5**0.5), 1 / 15)),
    26: (
        ((0.0, 0.0, 1.0), 1 / 21),
        ((0.0, 0.5**0.5, 0.5**0.5), 4 / 105),
        ((3**-0.5, 3**-0.5, 3**-0.5), 9 / 280),
    ),
    44: (
        ((0.0, 0.5**0.5, 0.5**0.5), 0.022379852539727116),
        ((3**-0.5, 3**-0.5, 3**-0.5), 0.024345135271135538),
        (
            (0.2661197192863606, 0.2661197192863606, (1 - 2 * 0.2661197192863606**2) ** 0.5),
            0.02236169530642458,
        ),
    ),
    50: (
        ((0.0, 0.0, 1.0), 4 / 315),
        ((0.0, 0.5**0.5, 0.5**0.5), 64 / 2835),
        ((3**-0.5, 3**-0.5, 3**-0.5), 27 / 1280),
        ((11**-0.5, 11**-0.5, 3 * 11**-0.5), 14641 / 725760),
    ),
    96: (
        (
            (0.6987095200040837, 0.6987095200040837, (1 - 2 * 0.6987095200040837**2) ** 0.5),
            0.011806239117329272,
        ),
        (
            (0.4332614506133654, 0.4332614506133654, (1 - 2 * 0.4332614506133654**2) ** 0.5),
            0.01484756804080873,
        ),
        ((0.05502664829054827, 0.2961641115400204, 0.953550673542638), 0.007506429754264332),
    ),
}
"""By number of points, the coordinates of one of each orbit and its weight."""


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


def sphere_quadrature(like: Tensor, count: int = 50) -> tuple[Tensor, Tensor]:
    """Unit directions `[count, 3]` and weights `[count]` whose sum is 1.

    The weighted sum over the directions is the mean over the sphere. `count`: 18, 26, 44, 50 or 96.
    """
    directions: list[tuple[float, ...]] = []
    weights: list[float] = []
    for corner, weight in _ORBITS[count]:
        orbit = {
            tuple(s * c for s, c in zip(signs, order, strict=True))
            for order in permutations(corner)
            for signs in product((1, -1), repeat=3)
        }
        directions += sorted({tuple(c + 0.0 for c in point) for point in orbit})
        weights += [weight] * (len(directions) - len(weights))
    return like.new_tensor(directions), like.new_tensor(weights)
