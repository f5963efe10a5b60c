"""p of a beam at a node (E2, E13), inside fused kernels, and both derivatives of that.

Of light from a point it is found by its formula; of light from one direction by the ray's
polynomial, or it is the same all along the ray and comes in later: 1.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused import optics
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.rays import ray_types, vectors
from ddrecon.numerics.chebyshev import COEFFICIENTS


def is_point(layout: Layout) -> Any:
    """Of each beam, whether it is light from a point."""
    numbers = [int(is_point) for is_point in layout.beams] or [0]
    return wp.types.vector(length=len(numbers), dtype=wp.int32)(*numbers)


@functools.cache
def _point_phase(layout: Layout, role: str) -> Any:
    """p by `depth` of the peak, cosine and g."""
    formulas = optics.phases(vectors(layout).F, role)
    return formulas.henyey_greenstein if layout.peak is None else formulas.peaked_phase


@functools.cache
def node_phase(layout: Layout) -> SimpleNamespace:
    """`peak_of` color c: kappa_peak per unit of mass; `depth_of` a mass; `phase`, p behind that."""
    t, records, IS_POINT = vectors(layout), ray_types(layout), is_point(layout)
    by_polynomial, points = optics.polynomials(t.F, "value"), optics.points(t.F, "value")
    phase_at_point = _point_phase(layout, "value")

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
        ray: records.Ray, depth: t.F, b: int, distance: t.F, coefficients: wp.array2d(dtype=t.F)
    ) -> t.F:
        if wp.static(IS_POINT)[b] == 1:
            cosine = points.point_cosine(ray.foot[b], ray.across[b], distance)
            return phase_at_point(depth, cosine, ray.g)
        if wp.static(layout.peak is not None):
            place = by_polynomial.place_of(depth)
            first = b * wp.static(COEFFICIENTS)
            p = by_polynomial.polynomial(coefficients, first, ray.index, place)
            return wp.max(p, t.F(0.0))
        return t.F(1.0)

    cosine = points.point_cosine
    return SimpleNamespace(peak_of=peak_of, depth_of=depth_of, phase=phase, cosine=cosine)


@functools.cache
def slopes_at_point(layout: Layout) -> SimpleNamespace:
    """What p of light from a point is differentiated by; and the record `Slopes` of all of these.

    Those of p by depth, cosine and g, and those of the cosine by foot, square distance and way.
    Warp writes functions that call `wp.grad` behind all others: only those may that kernels call.
    """
    t, points = vectors(layout), optics.points(vectors(layout).F, "derivative")

    @wp.struct
    class Slopes:
        depth: t.F
        cosine: t.F
        g: t.F
        foot: t.F
        across: t.F
        held: t.F

    phase = _point_phase(layout, "derivative")
    return SimpleNamespace(Slopes=Slopes, phase=phase, cosine=points.point_cosine)


@functools.cache
def node_phase_adjoint(layout: Layout) -> Any:
    """The function of the bars that `p_bar` of p behind `depth` is for depth, distance and ray."""
    t, Ray, Slopes = vectors(layout), ray_types(layout).Ray, slopes_at_point(layout).Slopes
    by_polynomial, IS_POINT = optics.polynomials(t.F, "value"), is_point(layout)

    @wp.func
    def add_polynomial_bar(bars: wp.array2d(dtype=t.F), first: int, ray: int, place: t.F, bar: t.F):
        power = bar
        for k in range(wp.static(COEFFICIENTS)):
            bars[first + k, ray] = bars[first + k, ray] + power
            power = power * place

    @wp.func
    def phase_adjoint(
        depth: t.F,
        slopes: Slopes,
        b: int,
        coefficients: wp.array2d(dtype=t.F),
        p: t.F,
        p_bar: t.F,
        ray_bar: Ray,
        held_bar: t.F,
        coefficients_bar: wp.array2d(dtype=t.F),
    ):
        depth_bar = t.F(0.0)
        if wp.static(IS_POINT)[b] == 1:
            depth_bar = p_bar * slopes.depth
            ray_bar.foot[b] += p_bar * slopes.cosine * slopes.foot
            ray_bar.across[b] += p_bar * slopes.cosine * slopes.across
            held_bar += p_bar * slopes.cosine * slopes.held
            ray_bar.g += p_bar * slopes.g
        elif wp.static(layout.peak is not None) and p > t.F(0.0):
            place = by_polynomial.place_of(depth)
            first = b * wp.static(COEFFICIENTS)
            slope = by_polynomial.polynomial_slope(coefficients, first, ray_bar.index, place)
            depth_bar = p_bar * slope
            # An array without rows takes none.
            if coefficients_bar.shape[0] > 0:
                add_polynomial_bar(coefficients_bar, first, ray_bar.index, place, p_bar)
        return depth_bar, held_bar, ray_bar

    return phase_adjoint


@functools.cache
def node_phase_tangent(layout: Layout) -> Any:
    """The function of the change of p behind `depth` with those of all its arguments."""
    t, Ray, Slopes = vectors(layout), ray_types(layout).Ray, slopes_at_point(layout).Slopes
    by_polynomial, IS_POINT = optics.polynomials(t.F, "value"), is_point(layout)

    @wp.func
    def phase_tangent(
        depth: t.F,
        slopes: Slopes,
        b: int,
        coefficients: wp.array2d(dtype=t.F),
        p: t.F,
        d_ray: Ray,
        d_depth: t.F,
        d_held: t.F,
        d_coefficients: wp.array2d(dtype=t.F),
    ) -> t.F:
        d_p = t.F(0.0)
        if wp.static(IS_POINT)[b] == 1:
            d_cosine = slopes.foot * d_ray.foot[b] + slopes.across * d_ray.across[b]
            d_cosine += slopes.held * d_held
            d_p = slopes.depth * d_depth + slopes.cosine * d_cosine + slopes.g * d_ray.g
        elif wp.static(layout.peak is not None) and p > t.F(0.0):
            r = d_ray.index
            place = by_polynomial.place_of(depth)
            first = b * wp.static(COEFFICIENTS)
            slope = by_polynomial.polynomial_slope(coefficients, first, r, place)
            d_p = slope * d_depth + by_polynomial.polynomial(d_coefficients, first, r, place)
        return d_p

    return phase_tangent
