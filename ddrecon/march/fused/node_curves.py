"""The coefficients of p of a beam at a node, inside fused kernels, and what they depend on.

Over the depth of the peak p is a polynomial (E13), or constant without a peak. Its coefficients are
the ray's, for light from one direction; for light from a point they come from a table, by the angle
at the node. Where p differs from cell to cell (`cellwise`), all come from tables by angle and by
the number there, or are those over a weight.
"""

import functools
import math
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused.cellwise import last_rung, table_rows
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.rays import ray_types, vectors
from ddrecon.medium.phase_cells import EVEN_STEPS, STEEP_STEP
from ddrecon.numerics.angle_table import STEPS

ROWS = 2 * (STEPS + 1)
"""Of a table over the angle: value and slope at each."""


def is_point(layout: Layout) -> Any:
    """Of each beam, whether it is light from a point."""
    numbers = [int(is_point) for is_point in layout.beams] or [0]
    return wp.types.vector(length=len(numbers), dtype=wp.int32)(*numbers)


@functools.cache
def _cubics(layout: Layout) -> SimpleNamespace:
    """What value and slope at two places count a part u of the way between them; and slopes."""
    t = vectors(layout)

    @wp.func
    def first_of(place: t.F, last: int) -> int:
        return wp.clamp(int(place), 0, last - 1)

    @wp.func
    def weights(u: t.F, step: t.F) -> t.Weights:
        """Hermite's cubics: values by (1 + 2 t)(1 - t)^2, slopes by t (1 - t)^2, and mirrored."""
        one, rest = t.F(1.0), t.F(1.0) - u
        low = t.Weights((one + u + u) * rest * rest, step * u * rest * rest, t.F(0.0), t.F(0.0))
        return low + t.Weights(
            t.F(0.0), t.F(0.0), (one + rest + rest) * u * u, -step * rest * u * u
        )

    @wp.func
    def slopes(u: t.F, step: t.F) -> t.Weights:
        rest = t.F(1.0) - u
        bend = t.F(6.0) * u * rest
        return t.Weights(-bend, step * rest * (rest - u - u), bend, step * u * (u - rest - rest))

    return SimpleNamespace(first_of=first_of, weights=weights, slopes=slopes)


@functools.cache
def spots(layout: Layout) -> SimpleNamespace:
    """Where in tables the angle of a beam at a node is, and how that turns along the ray.

    Four rows from `row` on, values and slopes on both sides of the angle, count by `weights`; these
    change with the place in the table by `slopes`, and the place along the ray by `along`, with the
    square of a point's distance from the ray by `across`. The `cosine` changes with it by `bend`.
    """
    t, records, cubic = vectors(layout), ray_types(layout), _cubics(layout)
    IS_POINT, step = is_point(layout), math.pi / STEPS

    @wp.struct
    class Spot:
        row: int
        weights: t.Weights
        slopes: t.Weights
        along: t.F
        across: t.F
        cosine: t.F
        bend: t.F

    @wp.func
    def spot_of(ray: records.Ray, light: records.Light, given: records.Bundle) -> Spot:
        spot, b = Spot(), light.b
        part = t.F(0.0)
        if wp.static(IS_POINT)[b] == 1:
            apart = wp.sqrt(ray.across[b])
            away = ray.foot[b] + light.held
            square = ray.across[b] + away * away
            per = t.F(wp.static(1.0 / step))
            spot.along = per * apart / square
            spot.across = -t.F(0.5) * per * away / (apart * square)
            spot.cosine = -away / wp.sqrt(square)
            spot.bend = -t.F(wp.static(step)) * apart / wp.sqrt(square)
            place = wp.atan2(apart, -away) * per
            spot.row = cubic.first_of(place, wp.static(STEPS))
            part = place - t.F(spot.row)
        else:
            at = b * wp.static(layout.ray_terms)
            spot.cosine = given.coefficients[at, ray.index]
            spot.row = int(given.coefficients[at + 1, ray.index])
            part = given.coefficients[at + 2, ray.index]
        spot.row = light.c * wp.static(layout.table_step * table_rows(layout)) + 2 * spot.row
        spot.weights = cubic.weights(part, t.F(wp.static(step)))
        spot.slopes = cubic.slopes(part, t.F(wp.static(step)))
        return spot

    return SimpleNamespace(Spot=Spot, spot_of=spot_of)


@functools.cache
def rungs(layout: Layout) -> SimpleNamespace:
    """The same of the number there: four tables from `first` on, and `slopes` by the number."""
    t, cubic = vectors(layout), _cubics(layout)
    is_steep, last = layout.form == "steep", last_rung(layout)

    @wp.struct
    class Rung:
        first: int
        weights: t.Weights
        slopes: t.Weights

    @wp.func
    def rung_of(number: t.F) -> Rung:
        rung = Rung()
        place = number * t.F(wp.static(EVEN_STEPS))
        slope = t.F(wp.static(EVEN_STEPS))
        if wp.static(is_steep):
            g = wp.max(number, t.F(0.0))
            one = t.F(1.0)
            place = t.F(wp.static(0.5 / STEEP_STEP)) * wp.log((one + g) / (one - g))
            slope = t.F(wp.static(1.0 / STEEP_STEP)) / (one - g * g)
        first = cubic.first_of(place, wp.static(last))
        rung.first = 2 * first
        rung.weights = cubic.weights(place - t.F(first), t.F(1.0))
        rung.slopes = slope * cubic.slopes(place - t.F(first), t.F(1.0))
        return rung

    return SimpleNamespace(Rung=Rung, rung_of=rung_of)


@functools.cache
def weighing(layout: Layout) -> SimpleNamespace:
    """Sums of a table's rows: of one over the angle, or of one over rung and angle."""
    t = vectors(layout)

    @wp.func
    def weigh(table: wp.array2d(dtype=t.F), row: int, weights: t.Weights) -> t.Curve:
        curve = t.Curve()
        for k in range(wp.static(layout.terms)):
            for j in range(4):
                curve[k] += weights[j] * table[row + j, k]
        return curve

    @wp.func
    def weigh_rungs(
        table: wp.array2d(dtype=t.F), rung: int, by_rung: t.Weights, row: int, by_angle: t.Weights
    ) -> t.Curve:
        curve = t.Curve()
        for i in range(4):
            curve += by_rung[i] * weigh(table, (rung + i) * wp.static(ROWS) + row, by_angle)
        return curve

    return SimpleNamespace(weigh=weigh, weigh_rungs=weigh_rungs)


@functools.cache
def curves(layout: Layout) -> SimpleNamespace:
    """`curve`: the coefficients of beam b in color c; `first`: where a ray's own stand.

    With `given` the changes of all that a kernel is given, they are the changes of coefficients.
    """
    t, records, table = vectors(layout), ray_types(layout), weighing(layout)
    spot_of, rung_of, IS_POINT = spots(layout).spot_of, rungs(layout).rung_of, is_point(layout)

    @wp.func
    def first(b: int, c: int) -> int:
        return b * wp.static(layout.ray_terms) + c * wp.static(layout.curve_step)

    @wp.func
    def curve(
        ray: records.Ray, light: records.Light, places: records.Bundle, given: records.Bundle
    ) -> t.Curve:
        """`places` has where rays look tables up."""
        if wp.static(layout.has_rungs):
            rung = rung_of(light.number)
            spot = spot_of(ray, light, places)
            return table.weigh_rungs(given.table, rung.first, rung.weights, spot.row, spot.weights)
        if wp.static(IS_POINT)[light.b] == 1:
            spot = spot_of(ray, light, places)
            return table.weigh(given.table, spot.row, spot.weights)
        own = t.Curve()
        for k in range(wp.static(layout.terms)):
            own[k] = given.coefficients[first(light.b, light.c) + k, ray.index]
        return own

    return SimpleNamespace(first=first, curve=curve)


@functools.cache
def spreading_curves(layout: Layout) -> Any:
    """The function that adds to bars of a ray's coefficients, or of tables, those of p's own.

    These are p's bar `p_bar` by powers of `place`. Arrays without rows take none.
    """
    t, records, IS_POINT = vectors(layout), ray_types(layout), is_point(layout)
    spot_of, rung_of, first = spots(layout).spot_of, rungs(layout).rung_of, curves(layout).first

    @wp.func
    def spread_row(
        bars: wp.array2d(dtype=t.F), row: int, weights: t.Weights, place: t.F, p_bar: t.F
    ):
        power = p_bar
        for k in range(wp.static(layout.terms)):
            for j in range(4):
                wp.atomic_add(bars, row + j, k, weights[j] * power)
            power = power * place

    @wp.func
    def spread_curve(
        ray: records.Ray,
        light: records.Light,
        given: records.Bundle,
        place: t.F,
        p_bar: t.F,
        bars: records.Bundle,
    ):
        if wp.static(layout.has_rungs):
            if bars.table.shape[0] > 0:
                rung = rung_of(light.number)
                spot = spot_of(ray, light, given)
                for i in range(4):
                    row = (rung.first + i) * wp.static(ROWS) + spot.row
                    spread_row(bars.table, row, spot.weights, place, rung.weights[i] * p_bar)
        elif wp.static(IS_POINT)[light.b] == 1:
            if bars.table.shape[0] > 0:
                spot = spot_of(ray, light, given)
                spread_row(bars.table, spot.row, spot.weights, place, p_bar)
        elif bars.coefficients.shape[0] > 0:
            power = p_bar
            for k in range(wp.static(layout.terms)):
                row = first(light.b, light.c) + k
                bars.coefficients[row, ray.index] = bars.coefficients[row, ray.index] + power
                power = power * place

    return spread_curve
