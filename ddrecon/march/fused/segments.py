"""What arrives from the segment between two nodes (E2, E3), and both derivatives of that.

Emission is linear along the segment, and so is depth: for each output the integral is the mean
emission, by the segment's measure, by the mean of exp(-depth).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.optics import optics
from ddrecon.march.fused.rays import ray_types, vectors


@functools.cache
def segments(layout: Layout) -> SimpleNamespace:
    """`arrive` with its adjoint and its tangent, for rays of `layout`."""
    types, Ray = vectors(layout), ray_types(layout).Ray
    F: Any = types.F
    Out = types.Out
    C, BEAMS, OUT, HAS_POINTS = (
        layout.colors,
        len(layout.beams),
        layout.outputs,
        any(layout.beams),
    )
    # The number of the point light that output i is of; -1 where it is of none.
    POINT = wp.types.vector(length=OUT, dtype=wp.int32)(
        *([-1] * C + [b if layout.beams[b] else -1 for b in range(BEAMS) for _ in range(C)])
    )
    value, derived = optics(F, "value"), optics(F, "derivative")
    mean_decay, mean_decay_slopes = value.mean_decay, value.mean_decay_slopes
    subtended, subtended_slopes = value.subtended, derived.subtended

    @wp.func
    def measure_of(ray: Ray, i: int, t0: F, t1: F) -> F:
        """What output `i` is integrated by: length, for a point light the integral of 1 / r^2."""
        if wp.static(HAS_POINTS):
            b = wp.static(POINT)[i]
            if b >= 0:
                return subtended(ray.foot[b], ray.across[b], t0, t1)
        return t1 - t0

    @wp.func
    def arrive(ray: Ray, w0: Out, w1: Out, u0: Out, u1: Out, x0: Out, x1: Out, t0: F, t1: F) -> Out:
        """All outputs, from emissions w, depths u, x = exp(-u) and distances t of both nodes."""
        out = Out()
        for i in range(wp.static(OUT)):
            decay = mean_decay(u0[i], u1[i], x0[i], x1[i])
            out[i] = F(0.5) * (w0[i] + w1[i]) * measure_of(ray, i, t0, t1) * decay
        return out

    @wp.func
    def arrive_adjoint(
        ray: Ray,
        w0: Out,
        w1: Out,
        u0: Out,
        u1: Out,
        x0: Out,
        x1: Out,
        t0: F,
        t1: F,
        bar: Out,
        ray_bar: Ray,
    ):
        """Bars of w (the same at both nodes), u0, u1, t0 and t1; `ray_bar` with its share added."""
        w_bar, u0_bar, u1_bar, t0_bar, t1_bar = Out(), Out(), Out(), F(0.0), F(0.0)
        for i in range(wp.static(OUT)):
            measure = measure_of(ray, i, t0, t1)
            slopes = mean_decay_slopes(u0[i], u1[i], x0[i], x1[i])
            mean = F(0.5) * (w0[i] + w1[i]) * bar[i]
            w_bar[i] = F(0.5) * bar[i] * measure * slopes[0]
            u0_bar[i] = mean * measure * slopes[1]
            u1_bar[i] = mean * measure * slopes[2]
            measure_bar = mean * slopes[0]
            b = wp.static(POINT)[i]
            if b >= 0:
                by_foot, by_across, by_t0, by_t1 = wp.grad(subtended_slopes)(
                    ray.foot[b], ray.across[b], t0, t1
                )
                ray_bar.foot[b] += measure_bar * by_foot
                ray_bar.across[b] += measure_bar * by_across
                t0_bar += measure_bar * by_t0
                t1_bar += measure_bar * by_t1
            else:
                t0_bar -= measure_bar
                t1_bar += measure_bar
        return w_bar, u0_bar, u1_bar, t0_bar, t1_bar, ray_bar

    @wp.func
    def arrive_tangent(
        ray: Ray,
        w0: Out,
        w1: Out,
        u0: Out,
        u1: Out,
        x0: Out,
        x1: Out,
        t0: F,
        t1: F,
        d_ray: Ray,
        d_w0: Out,
        d_w1: Out,
        d_u0: Out,
        d_u1: Out,
        d_t0: F,
        d_t1: F,
    ) -> Out:
        """The changes of all outputs."""
        out = Out()
        for i in range(wp.static(OUT)):
            measure = measure_of(ray, i, t0, t1)
            d_measure = d_t1 - d_t0
            b = wp.static(POINT)[i]
            if b >= 0:
                by_foot, by_across, by_t0, by_t1 = wp.grad(subtended_slopes)(
                    ray.foot[b], ray.across[b], t0, t1
                )
                d_measure = by_foot * d_ray.foot[b] + by_across * d_ray.across[b]
                d_measure += by_t0 * d_t0 + by_t1 * d_t1
            slopes = mean_decay_slopes(u0[i], u1[i], x0[i], x1[i])
            d_decay = slopes[1] * d_u0[i] + slopes[2] * d_u1[i]
            w = w0[i] + w1[i]
            change = (d_w0[i] + d_w1[i]) * measure * slopes[0]
            out[i] = F(0.5) * (change + w * d_measure * slopes[0] + w * measure * d_decay)
        return out

    return SimpleNamespace(
        arrive=arrive, arrive_adjoint=arrive_adjoint, arrive_tangent=arrive_tangent
    )
