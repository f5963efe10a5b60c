"""Directions and weights that integrate over the sphere, by Lebedev's rules and two more.

They are exact for polynomials up to some degree, and symmetric under every rotation and reflection
of the cube, so no axis of the grid is preferred. Sources: Lebedev 1975,
doi:10.1016/0041-5553(75)90133-0, and 1976, doi:10.1016/0041-5553(76)90100-2. That of 18 points
follows from the means of x^4 and of x^2 y^2 alone. That of 44 points is exact for the flux through
a face as well: the mean of |x|, of which Lebedev's rules lack 11, 8, 1 and 1 percent. It has the
means of x^4, x^2 y^2 z^2 and |x|, and those of degree 8 and 10 within 0.4 and 1.3 percent.
"""

from __future__ import annotations

from itertools import permutations, product

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
    86: (
        ((0.0, 0.0, 1.0), 0.01154401154401154),
        ((3**-0.5, 3**-0.5, 3**-0.5), 0.01194390908585628),
        (
            (0.3696028464541502, 0.3696028464541502, (1 - 2 * 0.3696028464541502**2) ** 0.5),
            0.01111055571060340,
        ),
        (
            (0.6943540066026664, 0.6943540066026664, (1 - 2 * 0.6943540066026664**2) ** 0.5),
            0.01187650129453714,
        ),
        ((0.0, 0.3742430390903412, (1 - 0.3742430390903412**2) ** 0.5), 0.01181230374690448),
    ),
}
"""By number of points, the coordinates of one of each orbit and its weight."""
DEGREES = {18: 5, 26: 7, 44: 7, 50: 11, 86: 15}
"""The degree up to which the rule of so many points is exact."""


def sphere_quadrature(like: Tensor, count: int = 50) -> tuple[Tensor, Tensor]:
    """Unit directions `[count, 3]` and weights `[count]` whose sum is 1.

    The weighted sum over the directions is the mean over the sphere. `count`: a key of `DEGREES`.
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
