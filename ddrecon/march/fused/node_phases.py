"""p of a beam at a node (E2, E13), inside fused kernels, and both derivatives of that.

It is a polynomial of coefficients that `node_curves` has. Without a peak, p of light from one
direction is the same along the ray and comes in later: 1. Where p differs from cell to cell by g,
it is Henyey and Greenstein's formula where that is not positive, or has no peak.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.node_curves import (
    curves,
    is_point,
    rungs,
    spots,
    spreading_curves,
    weighing,
)
from ddrecon.march.fused.rays import ray_types, vectors
from ddrecon.numerics.chebyshev import SCALE


@functools.cache
def node_phase(layout: Layout) -> SimpleNamespace:
    """`peak_of` color c: kappa_peak per unit of mass; `phase`: p of light at a node.

    `light_of` a beam behind a mass, all but p, and its change by `change_light`.
    """
    t, records, which = vectors(layout), ray_types(layout), _choices(layout)
    curve_of, over_depth = curves(layout).curve, _polynomial(layout)
    spot_of, plain = spots(layout).spot_of, _plain(layout)

    @wp.func
    def peak_of(v: t.Node, peak: t.Color, c: int) -> t.F:
        if wp.static(bool(layout.peak)):
            return v[wp.static(layout.first_peak) + c * wp.static(layout.peak_step)]
        return peak[c]

    @wp.func
    def number_of(v: t.Node, c: int) -> t.F:
        if wp.static(layout.form is not None):
            return v[wp.static(layout.first_number) + c * wp.static(layout.number_step)]
        return t.F(0.0)

    @wp.func
    def phase(ray: records.Ray, light: records.Light, given: records.Bundle) -> t.F:
        if which.is_plain(light.number):
            return plain.value(light.number, spot_of(ray, light, given).cosine)
        if which.has_curve(light.b):
            curve = curve_of(ray, light, given, given)
            p = over_depth.value(curve, over_depth.place(light.depth, light.number))
            if wp.static(layout.peak is None):
                return p
            return wp.max(p, t.F(0.0))
        return t.F(1.0)

    @wp.func
    def light_of(
        ray: records.Ray, v: t.Node, held: t.F, mass: t.F, b: int, c: int
    ) -> records.Light:
        light = records.Light()
        light.b = b
        light.c = c
        light.mass = mass
        if wp.static(layout.peak is not None):
            light.depth = peak_of(v, ray.peak, c) * mass
        light.number = number_of(v, c)
        light.held = held
        return light

    @wp.func
    def change_light(
        ray: records.Ray,
        v: t.Node,
        light: records.Light,
        d_ray: records.Ray,
        d_v: t.Node,
        d_held: t.F,
        d_mass: t.F,
    ) -> records.Light:
        d_light, c = records.Light(), light.c
        d_light.mass = d_mass
        if wp.static(layout.peak is not None):
            d_peak = peak_of(d_v, d_ray.peak, c)
            d_light.depth = d_peak * light.mass + peak_of(v, ray.peak, c) * d_mass
        d_light.number = number_of(d_v, c)
        d_light.held = d_held
        return d_light

    return SimpleNamespace(
        peak_of=peak_of, light_of=light_of, change_light=change_light, phase=phase
    )


@functools.cache
def _choices(layout: Layout) -> SimpleNamespace:
    """Whether p is by its formula, `is_plain`; or by coefficients, `has_curve`; else it is 1."""
    t, IS_POINT = vectors(layout), is_point(layout)
    is_curved = layout.peak is not None or layout.form == "linear"

    @wp.func
    def is_plain(number: t.F) -> bool:
        if wp.static(layout.form == "steep"):
            return wp.static(layout.peak is None) or number <= t.F(0.0)
        return False

    @wp.func
    def has_curve(b: int) -> bool:
        return wp.static(is_curved) or wp.static(IS_POINT)[b] == 1

    return SimpleNamespace(is_plain=is_plain, has_curve=has_curve)


@functools.cache
def _polynomial(layout: Layout) -> SimpleNamespace:
    """E13 by its coefficients at the `place` of a depth: `value`, and `slope` by depth.

    Without a peak the place is the number itself.
    """
    t, last = vectors(layout), layout.terms - 1

    @wp.func
    def place(depth: t.F, number: t.F) -> t.F:
        if wp.static(layout.peak is None):
            return number
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
def _plain(layout: Layout) -> SimpleNamespace:
    """(1 - g^2) / (1 + g^2 - 2 g w)^(3/2): `value`, and slopes `by_g` and `by_cosine`."""
    t = vectors(layout)

    @wp.func
    def square_of(g: t.F, cosine: t.F) -> t.F:
        return t.F(1.0) + g * g - t.F(2.0) * g * cosine

    @wp.func
    def value(g: t.F, cosine: t.F) -> t.F:
        square = square_of(g, cosine)
        return (t.F(1.0) - g * g) / (square * wp.sqrt(square))

    @wp.func
    def by_g(g: t.F, cosine: t.F) -> t.F:
        square = square_of(g, cosine)
        bend = t.F(3.0) * (t.F(1.0) - g * g) * (g - cosine) / square
        return (-t.F(2.0) * g - bend) / (square * wp.sqrt(square))

    @wp.func
    def by_cosine(g: t.F, cosine: t.F) -> t.F:
        square = square_of(g, cosine)
        return t.F(3.0) * g * (t.F(1.0) - g * g) / (square * square * wp.sqrt(square))

    return SimpleNamespace(value=value, by_g=by_g, by_cosine=by_cosine)


@functools.cache
def _slopes(layout: Layout) -> SimpleNamespace:
    """The function `find` of the derivatives of p by all but its coefficients.

    Those by the place in tables of the angle, and by the cosine, are of light from one direction;
    that of light from a point turns along the ray. `place`: where on the curve p is.
    """
    t, records, which = vectors(layout), ray_types(layout), _choices(layout)
    spot_of, rung_of, table = spots(layout).spot_of, rungs(layout).rung_of, weighing(layout)
    curve_of, over_depth, plain = curves(layout).curve, _polynomial(layout), _plain(layout)
    IS_POINT = is_point(layout)

    @wp.struct
    class Slopes:
        is_lit: bool
        place: t.F
        depth: t.F
        number: t.F
        along: t.F
        across: t.F
        angle: t.F
        cosine: t.F

    @wp.func
    def turn(slopes: Slopes, ray: records.Ray, light: records.Light, given: records.Bundle):
        """Hands the slope by a point's angle on to the ray's way past it."""
        spot = spot_of(ray, light, given)
        by_place = slopes.angle + slopes.cosine * spot.bend
        slopes.along = by_place * spot.along
        slopes.across = by_place * spot.across
        return slopes

    @wp.func
    def by_curve(ray: records.Ray, light: records.Light, given: records.Bundle) -> Slopes:
        slopes = Slopes()
        place = over_depth.place(light.depth, light.number)
        slopes.place = place
        slopes.is_lit = True
        curve = curve_of(ray, light, given, given)
        if wp.static(layout.peak is not None):
            slopes.depth = over_depth.slope(curve, place)
        if wp.static(layout.form == "linear"):
            slopes.number = curve[wp.static(layout.terms - 1)]
        if wp.static(layout.has_rungs):
            spot = spot_of(ray, light, given)
            rung = rung_of(light.number)
            climbing = table.weigh_rungs(
                given.table, rung.first, rung.slopes, spot.row, spot.weights
            )
            slopes.number = over_depth.value(climbing, place)
            turning = table.weigh_rungs(
                given.table, rung.first, rung.weights, spot.row, spot.slopes
            )
            slopes.angle = over_depth.value(turning, place)
        elif wp.static(IS_POINT)[light.b] == 1:
            spot = spot_of(ray, light, given)
            turning = table.weigh(given.table, spot.row, spot.slopes)
            slopes.angle = over_depth.value(turning, place)
        return slopes

    @wp.func
    def find(ray: records.Ray, light: records.Light, given: records.Bundle) -> Slopes:
        slopes = Slopes()
        if which.is_plain(light.number):
            cosine = spot_of(ray, light, given).cosine
            slopes.number = plain.by_g(light.number, cosine)
            slopes.cosine = plain.by_cosine(light.number, cosine)
        elif which.has_curve(light.b) and (wp.static(layout.peak is None) or light.p > t.F(0.0)):
            slopes = by_curve(ray, light, given)
        if wp.static(IS_POINT)[light.b] == 1:
            slopes = turn(slopes, ray, light, given)
        return slopes

    return SimpleNamespace(Slopes=Slopes, find=find)


@functools.cache
def node_phase_adjoint(layout: Layout) -> Any:
    """The function of the bars that `p_bar` of p is for depth, number, distance and ray.

    Those of coefficients are added to arrays; arrays without rows take none.
    """
    t, records, slopes = vectors(layout), ray_types(layout), _slopes(layout)
    Ray, Light, Bundle = records.Ray, records.Light, records.Bundle
    IS_POINT = is_point(layout)
    spread_curve = spreading_curves(layout)

    @wp.func
    def phase_adjoint(
        ray: Ray, light: Light, given: Bundle, p_bar: t.F, ray_bar: Ray, bars: Bundle
    ):
        by, b = slopes.find(ray, light, given), light.b
        ray_bar.foot[b] += p_bar * by.along
        ray_bar.across[b] += p_bar * by.across
        if by.is_lit:
            spread_curve(ray, light, given, by.place, p_bar, bars)
        if wp.static(layout.form in ("even", "steep")):  # noqa: SIM102 - static conditions alone
            if wp.static(IS_POINT)[b] == 0 and bars.coefficients.shape[0] > 0:
                r, at = ray.index, b * wp.static(layout.ray_terms)
                bars.coefficients[at, r] = bars.coefficients[at, r] + p_bar * by.cosine
                bars.coefficients[at + 2, r] = bars.coefficients[at + 2, r] + p_bar * by.angle
        return p_bar * by.depth, p_bar * by.number, p_bar * by.along, ray_bar

    return phase_adjoint


@functools.cache
def node_phase_tangent(layout: Layout) -> Any:
    """The function of the change of p with those of all its arguments."""
    t, records, slopes = vectors(layout), ray_types(layout), _slopes(layout)
    Ray, Light, Bundle = records.Ray, records.Light, records.Bundle
    IS_POINT = is_point(layout)
    curve_of, over_depth = curves(layout).curve, _polynomial(layout)

    @wp.func
    def phase_tangent(
        ray: Ray, light: Light, given: Bundle, d_ray: Ray, d_light: Light, d_given: Bundle
    ) -> t.F:
        by, b = slopes.find(ray, light, given), light.b
        d_p = by.depth * d_light.depth + by.number * d_light.number
        d_p += by.along * (d_ray.foot[b] + d_light.held) + by.across * d_ray.across[b]
        if by.is_lit:
            d_p += over_depth.value(curve_of(ray, light, given, d_given), by.place)
        if wp.static(layout.form in ("even", "steep")):  # noqa: SIM102 - static conditions alone
            if wp.static(IS_POINT)[b] == 0:
                at = b * wp.static(layout.ray_terms)
                d_p += by.cosine * d_given.coefficients[at, ray.index]
                d_p += by.angle * d_given.coefficients[at + 2, ray.index]
        return d_p

    return phase_tangent
