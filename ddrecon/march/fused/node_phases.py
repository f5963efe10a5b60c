"""p of a beam at a node (E2, E13), inside fused kernels, and both derivatives of that.

Over the depth of the peak p is a polynomial, or constant without a peak. Its coefficients are the
ray's, for light from one direction; for light from a point they come from a table, by the angle at
the node. Without a peak, p of light from one direction is the same along the ray and comes in
later: 1.
"""

import functools
import math
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.rays import ray_types, vectors
from ddrecon.numerics.angle_table import STEPS
from ddrecon.numerics.chebyshev import COEFFICIENTS, SCALE


def _is_point(layout: Layout) -> Any:
    """Of each beam, whether it is light from a point."""
    numbers = [int(is_point) for is_point in layout.beams] or [0]
    return wp.types.vector(length=len(numbers), dtype=wp.int32)(*numbers)


@functools.cache
def node_phase(layout: Layout) -> SimpleNamespace:
    """`peak_of` color c: kappa_peak per unit of mass; `depth_of` a mass; `phase`, p behind that."""
    t, records, IS_POINT = vectors(layout), ray_types(layout), _is_point(layout)
    curve_of, over_depth = _curves(layout).curve, _polynomial(layout)

    @wp.func
    def peak_of(v: t.Node, peak: t.Color, c: int) -> t.F:
        if wp.static(bool(layout.peak)):
            return v[wp.static(layout.first_peak) + c * wp.static(layout.peak_step)]
        return peak[c]

    @wp.func
    def depth_of(v: t.Node, peak: t.Color, c: int, mass: t.F) -> t.F:
        if wp.static(layout.peak is not None):
            return peak_of(v, peak, c) * mass
        return t.F(0.0)

    @wp.func
    def phase(
        ray: records.Ray, depth: t.F, b: int, c: int, held: t.F, given: records.Bundle
    ) -> t.F:
        if wp.static(IS_POINT)[b] == 1 or wp.static(layout.peak is not None):
            p = over_depth.value(curve_of(ray, b, c, held, given), over_depth.place(depth))
            if wp.static(layout.peak is None):
                return p
            return wp.max(p, t.F(0.0))
        return t.F(1.0)

    return SimpleNamespace(peak_of=peak_of, depth_of=depth_of, phase=phase)


@functools.cache
def _polynomial(layout: Layout) -> SimpleNamespace:
    """E13 by its coefficients at the `place` of a depth: `value`, and `slope` by depth."""
    t, last = vectors(layout), layout.terms - 1

    @wp.func
    def place(depth: t.F) -> t.F:
        return t.F(1.0) - t.F(wp.static(2.0 * SCALE)) / (depth + t.F(wp.static(SCALE)))

    @wp.func
    def value(curve: t.Curve, place: t.F) -> t.F:
        total = curve[wp.static(last)]
        for k in range(wp.static(last)):
            total = curve[wp.static(last - 1) - k] + total * place
        return total

    @wp.func
    def slope(curve: t.Curve, place: t.F) -> t.F:
        total = t.F(0.0)
        for k in range(wp.static(last)):
            total = t.F(wp.static(last) - k) * curve[wp.static(last) - k] + total * place
        away = t.F(1.0) - place
        return total * away * away * t.F(wp.static(0.5 / SCALE))

    return SimpleNamespace(place=place, value=value, slope=slope)


@functools.cache
def _spots(layout: Layout) -> SimpleNamespace:
    """Where in the table the angle of light from a point is, and how that turns along the ray.

    Four rows from `row` on, values and slopes on both sides of the angle, count by `weights`; these
    change with the angle by `slopes`, the angle along the ray by `along` and with the square of the
    point's distance from the ray by `across`.
    """
    t, Ray = vectors(layout), ray_types(layout).Ray
    step = math.pi / STEPS

    @wp.struct
    class Spot:
        row: int
        weights: t.Weights
        slopes: t.Weights
        along: t.F
        across: t.F

    @wp.func
    def spot_of(ray: Ray, b: int, c: int, held: t.F) -> Spot:
        spot = Spot()
        apart = wp.sqrt(ray.across[b])
        away = ray.foot[b] + held
        square = ray.across[b] + away * away
        spot.along = apart / square
        spot.across = -t.F(0.5) * away / (apart * square)
        place = wp.atan2(apart, -away) * t.F(wp.static(1.0 / step))
        first = wp.clamp(int(place), 0, wp.static(STEPS - 1))
        spot.row = 2 * (c * wp.static(layout.phase_step * (STEPS + 1)) + first)
        # Hermite's cubics: values by (1 + 2 t)(1 - t)^2, slopes by t (1 - t)^2, and mirrored.
        one, u = t.F(1.0), place - t.F(first)
        rest = one - u
        h = t.F(wp.static(step))
        spot.weights = t.Weights(
            (one + u + u) * rest * rest,
            h * u * rest * rest,
            (one + rest + rest) * u * u,
            -h * rest * u * u,
        )
        per = t.F(wp.static(1.0 / step))
        bend = t.F(6.0) * u * rest * per
        spot.slopes = t.Weights(-bend, rest * (rest - u - u), bend, u * (u - rest - rest))
        return spot

    @wp.func
    def weigh(table: wp.array2d(dtype=t.F), row: int, weights: t.Weights) -> t.Curve:
        curve = t.Curve()
        for k in range(wp.static(layout.terms)):
            for j in range(4):
                curve[k] += weights[j] * table[row + j, k]
        return curve

    return SimpleNamespace(Spot=Spot, spot_of=spot_of, weigh=weigh)


@functools.cache
def _curves(layout: Layout) -> SimpleNamespace:
    """`curve`: the coefficients of beam b in color c over depth; `first`: where a ray's stand."""
    t, records, spots = vectors(layout), ray_types(layout), _spots(layout)
    IS_POINT, spot_of, weigh = _is_point(layout), spots.spot_of, spots.weigh

    @wp.func
    def first(b: int, c: int) -> int:
        phase = b * wp.static(layout.phases) + c * wp.static(layout.phase_step)
        return phase * wp.static(COEFFICIENTS)

    @wp.func
    def curve(ray: records.Ray, b: int, c: int, held: t.F, given: records.Bundle) -> t.Curve:
        if wp.static(IS_POINT)[b] == 1:
            spot = spot_of(ray, b, c, held)
            return weigh(given.table, spot.row, spot.weights)
        own = t.Curve()
        for k in range(wp.static(layout.terms)):
            own[k] = given.coefficients[first(b, c) + k, ray.index]
        return own

    return SimpleNamespace(first=first, curve=curve)


@functools.cache
def node_phase_adjoint(layout: Layout) -> Any:
    """The function of the bars that `p_bar` of p behind `depth` is for depth, distance and ray.

    Those of coefficients are added to arrays; arrays without rows take none.
    """
    t, records, spots = vectors(layout), ray_types(layout), _spots(layout)
    Ray, Bundle, IS_POINT = records.Ray, records.Bundle, _is_point(layout)
    curves, over_depth = _curves(layout), _polynomial(layout)

    @wp.func
    def phase_adjoint(
        ray: Ray,
        held: t.F,
        depth: t.F,
        b: int,
        c: int,
        given: Bundle,
        p: t.F,
        p_bar: t.F,
        ray_bar: Ray,
        held_bar: t.F,
        bars: Bundle,
    ):
        depth_bar = t.F(0.0)
        place = over_depth.place(depth)
        has_peak = wp.static(layout.peak is not None)
        is_lit = p > t.F(0.0) or not has_peak
        if is_lit and (has_peak or wp.static(IS_POINT)[b] == 1):
            curve = curves.curve(ray, b, c, held, given)
            depth_bar = p_bar * over_depth.slope(curve, place)
            power = p_bar
            if wp.static(IS_POINT)[b] == 1:
                spot = spots.spot_of(ray, b, c, held)
                turning = spots.weigh(given.table, spot.row, spot.slopes)
                angle_bar = p_bar * over_depth.value(turning, place)
                ray_bar.foot[b] += angle_bar * spot.along
                ray_bar.across[b] += angle_bar * spot.across
                held_bar += angle_bar * spot.along
                if bars.table.shape[0] > 0:
                    for k in range(wp.static(layout.terms)):
                        for j in range(4):
                            wp.atomic_add(bars.table, spot.row + j, k, spot.weights[j] * power)
                        power = power * place
            elif bars.coefficients.shape[0] > 0:
                for k in range(wp.static(layout.terms)):
                    row = curves.first(b, c) + k
                    bars.coefficients[row, ray.index] = bars.coefficients[row, ray.index] + power
                    power = power * place
        return depth_bar, held_bar, ray_bar

    return phase_adjoint


@functools.cache
def node_phase_tangent(layout: Layout) -> Any:
    """The function of the change of p behind `depth` with those of all its arguments."""
    t, records, spots = vectors(layout), ray_types(layout), _spots(layout)
    Ray, Bundle, IS_POINT = records.Ray, records.Bundle, _is_point(layout)
    curves, over_depth = _curves(layout), _polynomial(layout)

    @wp.func
    def phase_tangent(
        ray: Ray,
        held: t.F,
        depth: t.F,
        b: int,
        c: int,
        given: Bundle,
        p: t.F,
        d_ray: Ray,
        d_depth: t.F,
        d_held: t.F,
        d_given: Bundle,
    ) -> t.F:
        d_p = t.F(0.0)
        place = over_depth.place(depth)
        has_peak = wp.static(layout.peak is not None)
        is_lit = p > t.F(0.0) or not has_peak
        if is_lit and (has_peak or wp.static(IS_POINT)[b] == 1):
            d_p = over_depth.slope(curves.curve(ray, b, c, held, given), place) * d_depth
            d_p += over_depth.value(curves.curve(ray, b, c, held, d_given), place)
            if wp.static(IS_POINT)[b] == 1:
                spot = spots.spot_of(ray, b, c, held)
                d_angle = spot.along * (d_ray.foot[b] + d_held) + spot.across * d_ray.across[b]
                turning = spots.weigh(given.table, spot.row, spot.slopes)
                d_p += over_depth.value(turning, place) * d_angle
        return d_p

    return phase_tangent
