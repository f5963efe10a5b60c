"""Where a place lies on a line of cells, inside fused kernels.

Values and slopes are those of `numerics.interpolation` and `numerics.third_order`: beyond the
outermost centers values stay, and on a cell's center, a kink, the slope is the mean of both sides.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.numerics.third_order import KINK

SIDE = 4
"""How many times as far as a kink reaches a place is looked at from one of its sides."""


@functools.cache
def lines(scalar: Any) -> SimpleNamespace:
    """`Place` and how it is found, for numbers of type `scalar`."""
    F = scalar
    kink = KINK * 2.0 ** (-52 if scalar is wp.float64 else -23)

    @wp.struct
    class Place:
        """The cells around a place on a line: m, i, j, p, of which it lies between i and j.

        `a` is the part of the way from i to j; `excess` a (1 - a) / 2, and its slope by a. Beyond
        the outermost centers `excess` is 0, and `live`, which is 1 else.
        """

        m: int
        i: int
        j: int
        p: int
        a: F
        excess: F
        excess_slope: F
        live: F

    @wp.func
    def cell(y: F, size: int, place: F) -> Place:
        """That of `place`, with the cells on both sides of `y`."""
        q = Place()
        c = wp.clamp(y, F(0.0), F(size - 1))
        q.i = wp.max(wp.min(int(c), size - 2), 0)  # also where y is not a number
        q.j = wp.min(q.i + 1, size - 1)
        q.m = wp.max(q.i - 1, 0)
        q.p = wp.min(q.j + 1, size - 1)
        q.a = wp.clamp(place, F(0.0), F(size - 1)) - F(q.i)
        if y > F(0.0) and y < F(size - 1):
            q.excess = F(0.5) * q.a * (F(1.0) - q.a)
            q.excess_slope = F(0.5) - q.a
            q.live = F(1.0)
        return q

    @wp.func
    def at(y: F, size: int) -> Place:
        """The place y, in cells, on a line of `size` cells."""
        return cell(y, size, y)

    @wp.func
    def is_on_kink(y: F, size: int) -> bool:
        """Whether y counts as the center of a cell."""
        return wp.abs(y - wp.round(y)) < F(wp.static(kink)) * F(size)

    @wp.func
    def at_side(y: F, size: int, side: F) -> Place:
        """The same, on a kink as seen from one `side`, -1 or 1."""
        if is_on_kink(y, size):
            return cell(y + side * F(wp.static(SIDE * kink)) * F(size), size, y)
        return cell(y, size, y)

    return SimpleNamespace(Place=Place, at=at, at_side=at_side, is_on_kink=is_on_kink)
