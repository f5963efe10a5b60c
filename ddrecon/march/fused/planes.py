"""Interpolation in one slice of cells, inside fused kernels.

Linear values, the third-order corrections of beams' masses (a (1 - a) / 2 second differences along
each axis), the slopes of both, and their adjoint.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.lines import lines
from ddrecon.march.fused.rays import vectors


@functools.cache
def values(layout: Layout) -> SimpleNamespace:
    """Linear values of cells [n, h, w, channels] in slice n, at places along h and w; slopes."""
    t, Place = vectors(layout), lines(vectors(layout).F).Place
    channels = layout.channels

    @wp.func
    def linear(f: wp.array4d(dtype=t.F), n: int, y: Place, x: Place) -> t.Node:
        v = t.Node()
        w00 = (t.F(1.0) - y.a) * (t.F(1.0) - x.a)
        w01 = (t.F(1.0) - y.a) * x.a
        w10 = y.a * (t.F(1.0) - x.a)
        w11 = y.a * x.a
        for c in range(wp.static(channels)):
            v[c] = (
                w00 * f[n, y.i, x.i, c]
                + w01 * f[n, y.i, x.j, c]
                + w10 * f[n, y.j, x.i, c]
                + w11 * f[n, y.j, x.j, c]
            )
        return v

    @wp.func
    def linear_slope(f: wp.array4d(dtype=t.F), n: int, y: Place, x: Place, along_y: bool) -> t.Node:
        v = t.Node()
        for c in range(wp.static(channels)):
            if along_y:
                v[c] = y.live * (
                    (t.F(1.0) - x.a) * (f[n, y.j, x.i, c] - f[n, y.i, x.i, c])
                    + x.a * (f[n, y.j, x.j, c] - f[n, y.i, x.j, c])
                )
            else:
                v[c] = x.live * (
                    (t.F(1.0) - y.a) * (f[n, y.i, x.j, c] - f[n, y.i, x.i, c])
                    + y.a * (f[n, y.j, x.j, c] - f[n, y.j, x.i, c])
                )
        return v

    return SimpleNamespace(linear=linear, linear_slope=linear_slope)


@functools.cache
def _bends(layout: Layout) -> SimpleNamespace:
    """Second differences of masses in cells i and j of both lines, weighted v and w."""
    t, Place = vectors(layout), lines(vectors(layout).F).Place
    Pair = wp.types.vector(length=2, dtype=t.F)
    first = layout.first_mass

    @wp.func
    def cell(f: wp.array4d(dtype=t.F), n: int, k: int, at: int, c: int, along_y: bool) -> t.F:
        if along_y:
            return f[n, k, at, c]
        return f[n, at, k, c]

    @wp.func
    def line_bend(
        f: wp.array4d(dtype=t.F), n: int, on: Place, at: int, c: int, v: Pair, along_y: bool
    ) -> t.F:
        """Those of cells `on` a line, the one with index `at` across it."""
        i = cell(f, n, on.i, at, c, along_y)
        j = cell(f, n, on.j, at, c, along_y)
        before = cell(f, n, on.m, at, c, along_y) - t.F(2.0) * i + j
        behind = i - t.F(2.0) * j + cell(f, n, on.p, at, c, along_y)
        return v[0] * before + v[1] * behind

    @wp.func
    def bends(
        f: wp.array4d(dtype=t.F), n: int, on: Place, over: Place, v: Pair, w: Pair, along_y: bool
    ) -> t.Bent:
        """Those along y, or x: `on` lines, by v, and `over` them from one to the next, by w."""
        out = t.Bent()
        for k in range(wp.static(layout.masses)):
            c = wp.static(first) + k
            out[k] = w[0] * line_bend(f, n, on, over.i, c, v, along_y)
            out[k] += w[1] * line_bend(f, n, on, over.j, c, v, along_y)
        return out

    @wp.func
    def along_y(f: wp.array4d(dtype=t.F), n: int, y: Place, x: Place, v: Pair, w: Pair) -> t.Bent:
        return bends(f, n, y, x, v, w, True)

    @wp.func
    def along_x(f: wp.array4d(dtype=t.F), n: int, y: Place, x: Place, v: Pair, w: Pair) -> t.Bent:
        return bends(f, n, x, y, w, v, False)

    return SimpleNamespace(along_y=along_y, along_x=along_x)


@functools.cache
def corrections(layout: Layout) -> SimpleNamespace:
    """The third-order corrections of masses there, and their slopes."""
    t, Place = vectors(layout), lines(vectors(layout).F).Place
    Pair = wp.types.vector(length=2, dtype=t.F)
    bends = _bends(layout)

    @wp.func
    def weights(x: Place) -> Pair:
        """Those of linear interpolation between the cells i and j."""
        return Pair(t.F(1.0) - x.a, x.a)

    @wp.func
    def correction(f: wp.array4d(dtype=t.F), n: int, y: Place, x: Place) -> t.Bent:
        """What linear interpolation is off by: a (1 - a) / 2 second differences an axis."""
        v = weights(y)
        w = weights(x)
        along_y = bends.along_y(f, n, y, x, v, w)
        return y.excess * along_y + x.excess * bends.along_x(f, n, y, x, v, w)

    @wp.func
    def correction_slope(
        f: wp.array4d(dtype=t.F), n: int, y: Place, x: Place, along_y: bool
    ) -> t.Bent:
        """Its derivative along y, or x: of the excess there, and of the weights."""
        v = weights(y)
        w = weights(x)
        step = Pair(t.F(-1.0), t.F(1.0))
        if along_y:
            by_excess = y.excess_slope * bends.along_y(f, n, y, x, v, w)
            by_weights = y.excess * bends.along_y(f, n, y, x, step, w)
            return y.live * (by_excess + by_weights + x.excess * bends.along_x(f, n, y, x, step, w))
        by_excess = x.excess_slope * bends.along_x(f, n, y, x, v, w)
        by_weights = x.excess * bends.along_x(f, n, y, x, v, step)
        return x.live * (by_excess + by_weights + y.excess * bends.along_y(f, n, y, x, v, step))

    return SimpleNamespace(correction=correction, correction_slope=correction_slope)


@functools.cache
def spreading(layout: Layout) -> Any:
    """The adjoint of linear values and corrections."""
    t, Place = vectors(layout), lines(vectors(layout).F).Place
    channels, first = layout.channels, layout.first_mass
    last = first + layout.masses

    @wp.func
    def scatter(
        g: wp.array4d(dtype=t.F), n: int, y: Place, x: Place, bar: t.Node, bent_bar: t.Bent
    ):
        """Adds what `bar` of linear values and `bent_bar` of corrections mean for the cells."""
        w00 = (t.F(1.0) - y.a) * (t.F(1.0) - x.a)
        w01 = (t.F(1.0) - y.a) * x.a
        w10 = y.a * (t.F(1.0) - x.a)
        w11 = y.a * x.a
        for c in range(wp.static(channels)):
            g00 = w00 * bar[c]
            g01 = w01 * bar[c]
            g10 = w10 * bar[c]
            g11 = w11 * bar[c]
            if wp.static(layout.masses > 0):  # noqa: SIM102 - static conditions stand alone
                if c >= wp.static(first) and c < wp.static(last):
                    ty = y.excess * bent_bar[c - wp.static(first)]
                    tx = x.excess * bent_bar[c - wp.static(first)]
                    wp.atomic_add(g, n, y.m, x.i, c, ty * w00)
                    wp.atomic_add(g, n, y.m, x.j, c, ty * w01)
                    wp.atomic_add(g, n, y.p, x.i, c, ty * w10)
                    wp.atomic_add(g, n, y.p, x.j, c, ty * w11)
                    wp.atomic_add(g, n, y.i, x.m, c, tx * w00)
                    wp.atomic_add(g, n, y.j, x.m, c, tx * w10)
                    wp.atomic_add(g, n, y.i, x.p, c, tx * w01)
                    wp.atomic_add(g, n, y.j, x.p, c, tx * w11)
                    g00 += ty * (w10 - t.F(2.0) * w00) + tx * (w01 - t.F(2.0) * w00)
                    g01 += ty * (w11 - t.F(2.0) * w01) + tx * (w00 - t.F(2.0) * w01)
                    g10 += ty * (w00 - t.F(2.0) * w10) + tx * (w11 - t.F(2.0) * w10)
                    g11 += ty * (w01 - t.F(2.0) * w11) + tx * (w10 - t.F(2.0) * w11)
            wp.atomic_add(g, n, y.i, x.i, c, g00)
            wp.atomic_add(g, n, y.i, x.j, c, g01)
            wp.atomic_add(g, n, y.j, x.i, c, g10)
            wp.atomic_add(g, n, y.j, x.j, c, g11)

    return scatter
