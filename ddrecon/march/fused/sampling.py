"""Values at a node, inside fused kernels: in the slice it lies in, or between two slices.

Functions of cells [n, h, w, channels] and a place q (plane, row, column) in them, in cells.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.lines import lines
from ddrecon.march.fused.planes import corrections, spreading, values
from ddrecon.march.fused.rays import vectors


@functools.cache
def sampling(layout: Layout, is_sliced: bool) -> SimpleNamespace:
    """`sample` for linear values, `correct` for masses' corrections, `spread` for their adjoint.

    A node that is not in slice n lies between slices z.i and z.j.
    """
    t, line = vectors(layout), lines(vectors(layout).F)
    plane, bend, over = values(layout), corrections(layout), _across(layout)

    @wp.func
    def sample(f: wp.array4d(dtype=t.F), n: int, q: t.Triple) -> t.Node:
        y = line.at(q[1], f.shape[1])
        x = line.at(q[2], f.shape[2])
        if wp.static(is_sliced):
            return plane.linear(f, n, y, x)
        z = line.at(q[0], f.shape[0])
        below = (t.F(1.0) - z.a) * plane.linear(f, z.i, y, x)
        return below + z.a * plane.linear(f, z.j, y, x)

    @wp.func
    def correct(f: wp.array4d(dtype=t.F), n: int, q: t.Triple) -> t.Bent:
        y = line.at(q[1], f.shape[1])
        x = line.at(q[2], f.shape[2])
        if wp.static(is_sliced):
            return bend.correction(f, n, y, x)
        z = line.at(q[0], f.shape[0])
        return (
            (t.F(1.0) - z.a) * bend.correction(f, z.i, y, x)
            + z.a * bend.correction(f, z.j, y, x)
            + z.excess * over.across(f, z, y, x, t.F(1.0) - z.a, z.a)
        )

    spread = _spreading_in(layout) if is_sliced else _spreading_between(layout)
    return SimpleNamespace(sample=sample, correct=correct, spread=spread)


@functools.cache
def slopes(layout: Layout, is_sliced: bool) -> SimpleNamespace:
    """Derivatives of `sample` and `correct` along an axis; on a kink the mean of both sides."""
    t, line, side = vectors(layout), lines(vectors(layout).F), _side_slopes(layout, is_sliced)

    @wp.func
    def any_kink(f: wp.array4d(dtype=t.F), q: t.Triple) -> bool:
        return (
            line.is_on_kink(q[1], f.shape[1])
            or line.is_on_kink(q[2], f.shape[2])
            or (wp.static(not is_sliced) and line.is_on_kink(q[0], f.shape[0]))
        )

    @wp.func
    def slope(f: wp.array4d(dtype=t.F), n: int, q: t.Triple, axis: int) -> t.Node:
        if any_kink(f, q):
            before = side.slope(f, n, q, axis, t.F(-1.0))
            return t.F(0.5) * (before + side.slope(f, n, q, axis, t.F(1.0)))
        return side.slope(f, n, q, axis, t.F(0.0))

    @wp.func
    def correct_slope(f: wp.array4d(dtype=t.F), n: int, q: t.Triple, axis: int) -> t.Bent:
        if any_kink(f, q):
            before = side.correct_slope(f, n, q, axis, t.F(-1.0))
            return t.F(0.5) * (before + side.correct_slope(f, n, q, axis, t.F(1.0)))
        return side.correct_slope(f, n, q, axis, t.F(0.0))

    return SimpleNamespace(slope=slope, correct_slope=correct_slope)


@functools.cache
def _side_slopes(layout: Layout, is_sliced: bool) -> SimpleNamespace:
    """The same as seen from one `side` of a kink, -1 or 1."""
    t, line = vectors(layout), lines(vectors(layout).F)
    plane, bend, over = values(layout), corrections(layout), _across(layout)

    @wp.func
    def slope(f: wp.array4d(dtype=t.F), n: int, q: t.Triple, axis: int, side: t.F) -> t.Node:
        y = line.at_side(q[1], f.shape[1], side)
        x = line.at_side(q[2], f.shape[2], side)
        if wp.static(is_sliced):
            return plane.linear_slope(f, n, y, x, axis == 1)
        z = line.at_side(q[0], f.shape[0], side)
        if axis == 0:
            return z.live * (plane.linear(f, z.j, y, x) - plane.linear(f, z.i, y, x))
        below = (t.F(1.0) - z.a) * plane.linear_slope(f, z.i, y, x, axis == 1)
        return below + z.a * plane.linear_slope(f, z.j, y, x, axis == 1)

    @wp.func
    def correct_slope(
        f: wp.array4d(dtype=t.F), n: int, q: t.Triple, axis: int, side: t.F
    ) -> t.Bent:
        y = line.at_side(q[1], f.shape[1], side)
        x = line.at_side(q[2], f.shape[2], side)
        if wp.static(is_sliced):
            return bend.correction_slope(f, n, y, x, axis == 1)
        z = line.at_side(q[0], f.shape[0], side)
        if axis == 0:
            return z.live * (
                bend.correction(f, z.j, y, x)
                - bend.correction(f, z.i, y, x)
                + z.excess_slope * over.across(f, z, y, x, t.F(1.0) - z.a, z.a)
                + z.excess * over.across(f, z, y, x, t.F(-1.0), t.F(1.0))
            )
        return (
            (t.F(1.0) - z.a) * bend.correction_slope(f, z.i, y, x, axis == 1)
            + z.a * bend.correction_slope(f, z.j, y, x, axis == 1)
            + z.excess * over.across_slope(f, z, y, x, axis == 1)
        )

    return SimpleNamespace(slope=slope, correct_slope=correct_slope)


@functools.cache
def _across(layout: Layout) -> SimpleNamespace:
    """Second differences of masses across slices, weighted z0 and z1; and their slopes."""
    t, Place = vectors(layout), lines(vectors(layout).F).Place
    plane = values(layout)

    @wp.func
    def pick(v: t.Node) -> t.Bent:
        out = t.Bent()
        for k in range(wp.static(layout.masses)):
            out[k] = v[wp.static(layout.first_mass) + k]
        return out

    @wp.func
    def across(f: wp.array4d(dtype=t.F), z: Place, y: Place, x: Place, z0: t.F, z1: t.F) -> t.Bent:
        m = pick(plane.linear(f, z.m, y, x))
        i = pick(plane.linear(f, z.i, y, x))
        j = pick(plane.linear(f, z.j, y, x))
        p = pick(plane.linear(f, z.p, y, x))
        return z0 * (m - t.F(2.0) * i + j) + z1 * (i - t.F(2.0) * j + p)

    @wp.func
    def across_slope(
        f: wp.array4d(dtype=t.F), z: Place, y: Place, x: Place, along_y: bool
    ) -> t.Bent:
        m = pick(plane.linear_slope(f, z.m, y, x, along_y))
        i = pick(plane.linear_slope(f, z.i, y, x, along_y))
        j = pick(plane.linear_slope(f, z.j, y, x, along_y))
        p = pick(plane.linear_slope(f, z.p, y, x, along_y))
        return (t.F(1.0) - z.a) * (m - t.F(2.0) * i + j) + z.a * (i - t.F(2.0) * j + p)

    return SimpleNamespace(across=across, across_slope=across_slope)


@functools.cache
def _spreading_in(layout: Layout) -> Any:
    """The adjoint of `sample` and `correct` of a node in slice n."""
    t, line, scatter = vectors(layout), lines(vectors(layout).F), spreading(layout)

    @wp.func
    def spread(g: wp.array4d(dtype=t.F), n: int, q: t.Triple, bar: t.Node, bent_bar: t.Bent):
        scatter(g, n, line.at(q[1], g.shape[1]), line.at(q[2], g.shape[2]), bar, bent_bar)

    return spread


@functools.cache
def _spreading_between(layout: Layout) -> Any:
    """The adjoint of `sample` and `correct` of a node between two slices."""
    t, line, scatter = vectors(layout), lines(vectors(layout).F), spreading(layout)

    @wp.func
    def spread(g: wp.array4d(dtype=t.F), n: int, q: t.Triple, bar: t.Node, bent_bar: t.Bent):
        z = line.at(q[0], g.shape[0])
        y = line.at(q[1], g.shape[1])
        x = line.at(q[2], g.shape[2])
        z0 = t.F(1.0) - z.a
        bar_i = z0 * bar
        bar_j = z.a * bar
        if wp.static(layout.masses > 0):
            bar_m = t.Node()
            bar_p = t.Node()
            for k in range(wp.static(layout.masses)):
                at = wp.static(layout.first_mass) + k
                s = z.excess * bent_bar[k]
                bar_m[at] = s * z0
                bar_p[at] = s * z.a
                bar_i[at] += s * (z.a - t.F(2.0) * z0)
                bar_j[at] += s * (z0 - t.F(2.0) * z.a)
            none = t.Bent()
            scatter(g, z.m, y, x, bar_m, none)
            scatter(g, z.p, y, x, bar_p, none)
        scatter(g, z.i, y, x, bar_i, z0 * bent_bar)
        scatter(g, z.j, y, x, bar_j, z.a * bent_bar)

    return spread
