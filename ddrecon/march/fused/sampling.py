"""Values at a node, inside fused kernels: in the slice it lies in, or between two slices."""

import functools
from types import SimpleNamespace

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.lines import lines
from ddrecon.march.fused.planes import planes
from ddrecon.march.fused.rays import vectors


@functools.cache
def sampling(layout: Layout, is_sliced: bool) -> SimpleNamespace:
    """Functions of cells [n, h, w, channels] and a place q (plane, row, column) in them, in cells.

    `sample` are linear values and `correct` the third-order corrections of masses, `slope` and
    `correct_slope` their derivatives along an axis, and `spread` the adjoint of both.
    """
    types, line, plane = vectors(layout), lines(vectors(layout).F), planes(layout)
    F, Node, Bent, Triple = types.F, types.Node, types.Bent, types.Triple
    MASSES, first = layout.masses, layout.first_mass
    Place, at, at_side, is_on_kink = line.Place, line.at, line.at_side, line.is_on_kink
    linear, linear_slope, scatter = plane.linear, plane.linear_slope, plane.scatter
    correction, correction_slope = plane.correction, plane.correction_slope

    if is_sliced:

        @wp.func
        def sample(f: wp.array4d(dtype=F), n: int, q: Triple) -> Node:
            return linear(f, n, at(q[1], f.shape[1]), at(q[2], f.shape[2]))

        @wp.func
        def correct(f: wp.array4d(dtype=F), n: int, q: Triple) -> Bent:
            return correction(f, n, at(q[1], f.shape[1]), at(q[2], f.shape[2]))

        @wp.func
        def spread(g: wp.array4d(dtype=F), n: int, q: Triple, bar: Node, t: Bent):
            scatter(g, n, at(q[1], g.shape[1]), at(q[2], g.shape[2]), bar, t)

        @wp.func
        def side_slope(f: wp.array4d(dtype=F), n: int, q: Triple, axis: int, side: F) -> Node:
            return linear_slope(
                f, n, at_side(q[1], f.shape[1], side), at_side(q[2], f.shape[2], side), axis == 1
            )

        @wp.func
        def side_correction_slope(
            f: wp.array4d(dtype=F), n: int, q: Triple, axis: int, side: F
        ) -> Bent:
            return correction_slope(
                f, n, at_side(q[1], f.shape[1], side), at_side(q[2], f.shape[2], side), axis == 1
            )
    else:

        @wp.func
        def sample(f: wp.array4d(dtype=F), n: int, q: Triple) -> Node:
            z = at(q[0], f.shape[0])
            y = at(q[1], f.shape[1])
            x = at(q[2], f.shape[2])
            return (F(1.0) - z.a) * linear(f, z.i, y, x) + z.a * linear(f, z.j, y, x)

        @wp.func
        def pick(v: Node) -> Bent:
            out = Bent()
            for k in range(wp.static(MASSES)):
                out[k] = v[wp.static(first) + k]
            return out

        @wp.func
        def across(f: wp.array4d(dtype=F), z: Place, y: Place, x: Place, z0: F, z1: F) -> Bent:
            m = pick(linear(f, z.m, y, x))
            i = pick(linear(f, z.i, y, x))
            j = pick(linear(f, z.j, y, x))
            p = pick(linear(f, z.p, y, x))
            return z0 * (m - F(2.0) * i + j) + z1 * (i - F(2.0) * j + p)

        @wp.func
        def across_slope(
            f: wp.array4d(dtype=F), z: Place, y: Place, x: Place, along_y: bool
        ) -> Bent:
            m = pick(linear_slope(f, z.m, y, x, along_y))
            i = pick(linear_slope(f, z.i, y, x, along_y))
            j = pick(linear_slope(f, z.j, y, x, along_y))
            p = pick(linear_slope(f, z.p, y, x, along_y))
            return (F(1.0) - z.a) * (m - F(2.0) * i + j) + z.a * (i - F(2.0) * j + p)

        @wp.func
        def correct(f: wp.array4d(dtype=F), n: int, q: Triple) -> Bent:
            z = at(q[0], f.shape[0])
            y = at(q[1], f.shape[1])
            x = at(q[2], f.shape[2])
            return (
                (F(1.0) - z.a) * correction(f, z.i, y, x)
                + z.a * correction(f, z.j, y, x)
                + z.excess * across(f, z, y, x, F(1.0) - z.a, z.a)
            )

        @wp.func
        def spread(g: wp.array4d(dtype=F), n: int, q: Triple, bar: Node, t: Bent):
            z = at(q[0], g.shape[0])
            y = at(q[1], g.shape[1])
            x = at(q[2], g.shape[2])
            z0 = F(1.0) - z.a
            bar_i = z0 * bar
            bar_j = z.a * bar
            if wp.static(MASSES > 0):
                bar_m = Node()
                bar_p = Node()
                for k in range(wp.static(MASSES)):
                    s = z.excess * t[k]
                    bar_m[wp.static(first) + k] = s * z0
                    bar_p[wp.static(first) + k] = s * z.a
                    bar_i[wp.static(first) + k] += s * (z.a - F(2.0) * z0)
                    bar_j[wp.static(first) + k] += s * (z0 - F(2.0) * z.a)
                none = Bent()
                scatter(g, z.m, y, x, bar_m, none)
                scatter(g, z.p, y, x, bar_p, none)
            scatter(g, z.i, y, x, bar_i, z0 * t)
            scatter(g, z.j, y, x, bar_j, z.a * t)

        @wp.func
        def side_slope(f: wp.array4d(dtype=F), n: int, q: Triple, axis: int, side: F) -> Node:
            z = at_side(q[0], f.shape[0], side)
            y = at_side(q[1], f.shape[1], side)
            x = at_side(q[2], f.shape[2], side)
            if axis == 0:
                return z.live * (linear(f, z.j, y, x) - linear(f, z.i, y, x))
            return (F(1.0) - z.a) * linear_slope(f, z.i, y, x, axis == 1) + z.a * linear_slope(
                f, z.j, y, x, axis == 1
            )

        @wp.func
        def side_correction_slope(
            f: wp.array4d(dtype=F), n: int, q: Triple, axis: int, side: F
        ) -> Bent:
            z = at_side(q[0], f.shape[0], side)
            y = at_side(q[1], f.shape[1], side)
            x = at_side(q[2], f.shape[2], side)
            if axis == 0:
                return z.live * (
                    correction(f, z.j, y, x)
                    - correction(f, z.i, y, x)
                    + z.excess_slope * across(f, z, y, x, F(1.0) - z.a, z.a)
                    + z.excess * across(f, z, y, x, F(-1.0), F(1.0))
                )
            return (
                (F(1.0) - z.a) * correction_slope(f, z.i, y, x, axis == 1)
                + z.a * correction_slope(f, z.j, y, x, axis == 1)
                + z.excess * across_slope(f, z, y, x, axis == 1)
            )

    @wp.func
    def any_kink(f: wp.array4d(dtype=F), q: Triple) -> bool:
        return (
            is_on_kink(q[1], f.shape[1])
            or is_on_kink(q[2], f.shape[2])
            or (wp.static(not is_sliced) and is_on_kink(q[0], f.shape[0]))
        )

    @wp.func
    def slope(f: wp.array4d(dtype=F), n: int, q: Triple, axis: int) -> Node:
        """The mean of both sides where the place is on a kink."""
        if any_kink(f, q):
            return F(0.5) * (side_slope(f, n, q, axis, F(-1.0)) + side_slope(f, n, q, axis, F(1.0)))
        return side_slope(f, n, q, axis, F(0.0))

    @wp.func
    def correct_slope(f: wp.array4d(dtype=F), n: int, q: Triple, axis: int) -> Bent:
        if any_kink(f, q):
            return F(0.5) * (
                side_correction_slope(f, n, q, axis, F(-1.0))
                + side_correction_slope(f, n, q, axis, F(1.0))
            )
        return side_correction_slope(f, n, q, axis, F(0.0))

    return SimpleNamespace(
        sample=sample, correct=correct, spread=spread, slope=slope, correct_slope=correct_slope
    )
