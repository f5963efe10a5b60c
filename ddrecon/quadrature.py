"""Directions and weights that integrate over the sphere: the 50-point rule of Lebedev, exact for polynomials up to degree 11.

It is symmetric under every rotation and reflection of the cube, so no axis of the grid is preferred.
Source: Lebedev 1976, doi:10.1016/0041-5553(76)90100-2.
"""

from __future__ import annotations

from itertools import permutations, product

from torch import Tensor

_ORBITS = (
    ((0.0, 0.0, 1.0), 4 / 315),
    ((0.0, 0.5**0.5, 0.5**0.5), 64 / 2835),
    ((3**-0.5, 3**-0.5, 3**-0.5), 27 / 1280),
    ((11**-0.5, 11**-0.5, 3 * 11**-0.5), 14641 / 725760),
)


def sphere_quadrature(like: Tensor) -> tuple[Tensor, Tensor]:
    """Unit directions `[50, 3]` and weights `[50]` whose sum is 1: the mean over the sphere is the weighted sum."""
    directions: list[tuple[float, ...]] = []
    weights: list[float] = []
    for corner, weight in _ORBITS:
        orbit = {
            tuple(s * c for s, c in zip(signs, order, strict=True))
            for order in permutations(corner)
            for signs in product((1, -1), repeat=3)
        }
        directions += sorted({tuple(c + 0.0 for c in point) for point in orbit})
        weights += [weight] * (len(directions) - len(weights))
    return like.new_tensor(directions), like.new_tensor(weights)
