"""What arrives from the segment between two nodes (E2, E3), and both derivatives of that.

Emission is linear along the segment, and so is depth: for each output the integral is the mean
emission, by the segment's measure, by the mean of exp(-depth).
"""

import functools
from typing import Any

import warp as wp

from ddrecon.march.fused import optics
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.rays import ray_types, vectors


def _point_of(layout: Layout) -> Any:
    """The number of the point light that each output is of; -1 where it is of none."""
    colors = layout.colors
    of_beams = [
        b if is_point else -1 for b, is_point in enumerate(layout.beams) for _ in range(colors)
    ]
    return wp.types.vector(length=layout.outputs, dtype=wp.int32)(*([-1] * colors + of_beams))


@functools.cache
def _measure(layout: Layout) -> Any:
    """What an output is integrated by: length, for a point light the integral of 1 / r^2."""
    t, Ray, points = (
        vectors(layout),
        ray_types(layout).Ray,
        optics.points(vectors(layout).F, "value"),
    )
    POINT = _point_of(layout)

    @wp.func
    def measure_of(ray: Ray, i: int, t0: t.F, t1: t.F) -> t.F:
        if wp.static(any(layout.beams)):
            b = wp.static(POINT)[i]
            if b >= 0:
                return points.subtended(ray.foot[b], ray.across[b], t0, t1)
        return t1 - t0

    return measure_of


@functools.cache
def arrival(layout: Layout) -> Any:
    """The function that finds what arrives of all outputs."""
    t, records, measure_of = vectors(layout), ray_types(layout), _measure(layout)
    decays = optics.decays(t.F, "value")

    @wp.func
    def arrive(ray: records.Ray, a: records.Stop, b: records.Stop) -> t.Out:
        out = t.Out()
        for i in range(wp.static(layout.outputs)):
            decay = decays.mean_decay(a.u[i], b.u[i], a.decay[i], b.decay[i])
            out[i] = t.F(0.5) * (a.w[i] + b.w[i]) * measure_of(ray, i, a.held, b.held) * decay
        return out

    return arrive


@functools.cache
def arrival_adjoint(layout: Layout) -> Any:
    """The function that adds to bars of both stops and of the ray what `bar` of outputs is."""
    t, records, measure_of = vectors(layout), ray_types(layout), _measure(layout)
    decays, POINT = optics.decays(t.F, "value"), _point_of(layout)
    subtended_slopes = optics.points(t.F, "derivative").subtended
    Ray, Stop = records.Ray, records.Stop

    @wp.func
    def arrive_adjoint(
        ray: Ray, a: Stop, b: Stop, bar: t.Out, ray_bar: Ray, a_bar: Stop, b_bar: Stop
    ):
        a_t_bar, b_t_bar = t.F(0.0), t.F(0.0)
        for i in range(wp.static(layout.outputs)):
            measure = measure_of(ray, i, a.held, b.held)
            slopes = decays.mean_decay_slopes(a.u[i], b.u[i], a.decay[i], b.decay[i])
            mean = t.F(0.5) * (a.w[i] + b.w[i]) * bar[i]
            w_bar = t.F(0.5) * bar[i] * measure * slopes[0]
            a_bar.w[i] += w_bar
            b_bar.w[i] += w_bar
            a_bar.u[i] += mean * measure * slopes[1]
            b_bar.u[i] += mean * measure * slopes[2]
            measure_bar = mean * slopes[0]
            p = wp.static(POINT)[i]
            if p >= 0:
                by_foot, by_across, by_a, by_b = wp.grad(subtended_slopes)(
                    ray.foot[p], ray.across[p], a.held, b.held
                )
                ray_bar.foot[p] += measure_bar * by_foot
                ray_bar.across[p] += measure_bar * by_across
                a_t_bar += measure_bar * by_a
                b_t_bar += measure_bar * by_b
            else:
                a_t_bar -= measure_bar
                b_t_bar += measure_bar
        a_bar.held += a_t_bar
        b_bar.held += b_t_bar
        return ray_bar, a_bar, b_bar

    return arrive_adjoint


@functools.cache
def arrival_tangent(layout: Layout) -> Any:
    """The function that finds the changes of all outputs."""
    t, records, measure_of = vectors(layout), ray_types(layout), _measure(layout)
    decays, POINT = optics.decays(t.F, "value"), _point_of(layout)
    subtended_slopes = optics.points(t.F, "derivative").subtended
    Ray, Stop = records.Ray, records.Stop

    @wp.func
    def arrive_tangent(ray: Ray, a: Stop, b: Stop, d_ray: Ray, d_a: Stop, d_b: Stop) -> t.Out:
        out = t.Out()
        for i in range(wp.static(layout.outputs)):
            measure = measure_of(ray, i, a.held, b.held)
            d_measure = d_b.held - d_a.held
            p = wp.static(POINT)[i]
            if p >= 0:
                by_foot, by_across, by_a, by_b = wp.grad(subtended_slopes)(
                    ray.foot[p], ray.across[p], a.held, b.held
                )
                d_measure = by_foot * d_ray.foot[p] + by_across * d_ray.across[p]
                d_measure += by_a * d_a.held + by_b * d_b.held
            slopes = decays.mean_decay_slopes(a.u[i], b.u[i], a.decay[i], b.decay[i])
            d_decay = slopes[1] * d_a.u[i] + slopes[2] * d_b.u[i]
            w = a.w[i] + b.w[i]
            change = (d_a.w[i] + d_b.w[i]) * measure * slopes[0]
            out[i] = t.F(0.5) * (change + w * d_measure * slopes[0] + w * measure * d_decay)
        return out

    return arrive_tangent
