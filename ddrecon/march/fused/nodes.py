"""What a node of a ray emits towards the camera and through how much, and both derivatives of that.

The outputs of a ray are numbered: C colors of diffuse light, then C of each beam. For each of them
a node has an emission (kappa_s times radiance or p, per unit of scale) and a depth (to the camera,
for beams to the light as well); light that arrives is the integral of emission times exp(-depth).
"""

import functools
from types import SimpleNamespace

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.optics import optics
from ddrecon.march.fused.rays import ray_types, vectors
from ddrecon.numerics.chebyshev import COEFFICIENTS


@functools.cache
def nodes(layout: Layout) -> SimpleNamespace:
    """The functions below for rays of `layout`."""
    types, Ray = vectors(layout), ray_types(layout).Ray
    F, Node, Mass, Color, Out = types.F, types.Node, types.Mass, types.Color, types.Out
    C, K, BEAMS = layout.colors, layout.extinction, len(layout.beams)
    # The channel of color c is the first of its kind plus c times its step, 0 where all share one.
    k_step, d_step = int(K > 1), int(layout.diffuse > 1)
    d_first, b_first, p_first = K, layout.first_mass, layout.first_peak
    s_first, s_step = (
        (layout.first_scattering, int(layout.scattering > 1)) if layout.scattering else (0, k_step)
    )
    p_step = int((layout.peak or 0) > 1)
    HAS_PEAK, IS_PEAK_FIELD = layout.peak is not None, bool(layout.peak)
    IS_POINT = wp.types.vector(length=max(BEAMS, 1), dtype=wp.int32)(
        *([int(is_point) for is_point in layout.beams] or [0])
    )
    value, derived = optics(F, "value"), optics(F, "derivative")
    phase_at_point = value.peaked_phase if HAS_PEAK else value.henyey_greenstein
    phase_slopes = derived.peaked_phase if HAS_PEAK else derived.henyey_greenstein
    place_of, polynomial, polynomial_slope = (
        value.place_of,
        value.polynomial,
        value.polynomial_slope,
    )
    point_cosine, cosine_slopes = value.point_cosine, derived.point_cosine

    @wp.func
    def peak_of(v: Node, peak: Color, c: int) -> F:
        if wp.static(IS_PEAK_FIELD):
            return v[wp.static(p_first) + c * wp.static(p_step)]
        return peak[c]

    @wp.func
    def phase(ray: Ray, depth: F, b: int, t: F, coefficients: wp.array2d(dtype=F)) -> F:
        """p of beam `b` at a node; 1 where it is the same along the ray and comes in later."""
        if wp.static(IS_POINT)[b] == 1:
            return phase_at_point(depth, point_cosine(ray.foot[b], ray.across[b], t), ray.g)
        if wp.static(HAS_PEAK):
            p = polynomial(coefficients, b * wp.static(COEFFICIENTS), ray.index, place_of(depth))
            return wp.max(p, F(0.0))
        return F(1.0)

    @wp.func
    def emit(ray: Ray, v: Node, m: Mass, t: F, coefficients: wp.array2d(dtype=F)):
        """Emission, depth and p of all outputs at a node behind the mass `m`."""
        emission, depth, phases = Out(), Out(), Out()
        for c in range(wp.static(C)):
            k = c * wp.static(k_step)
            emission[c] = (
                v[wp.static(s_first) + c * wp.static(s_step)]
                * v[wp.static(d_first) + c * wp.static(d_step)]
            )
            depth[c] = ray.scale[c] * m[k]
        for b in range(wp.static(BEAMS)):
            for c in range(wp.static(C)):
                i = wp.static(C) + b * wp.static(C) + c
                k = c * wp.static(k_step)
                mass = m[k] + v[wp.static(b_first) + b * wp.static(K) + k]
                way = F(0.0)
                if wp.static(HAS_PEAK):
                    way = peak_of(v, ray.peak, c) * mass
                p = phase(ray, way, b, t, coefficients)
                phases[i] = p
                emission[i] = v[wp.static(s_first) + c * wp.static(s_step)] * p
                depth[i] = ray.scale[c] * mass
        return emission, depth, phases

    @wp.func
    def add_polynomial_bar(bars: wp.array2d(dtype=F), first: int, ray: int, place: F, bar: F):
        power = bar
        for k in range(wp.static(COEFFICIENTS)):
            bars[first + k, ray] = bars[first + k, ray] + power
            power = power * place

    @wp.func
    def emit_adjoint(
        ray: Ray,
        v: Node,
        m: Mass,
        t: F,
        coefficients: wp.array2d(dtype=F),
        phases: Out,
        emission_bar: Out,
        depth_bar: Out,
        ray_bar: Ray,
        coefficients_bar: wp.array2d(dtype=F),
    ):
        """Bars of node, mass and distance from those of `emit`; `ray_bar` with its share added.

        Those of `coefficients` are added to an array; one without rows takes none.
        """
        v_bar, m_bar, t_bar = Node(), Mass(), F(0.0)
        for c in range(wp.static(C)):
            k = c * wp.static(k_step)
            s = wp.static(s_first) + c * wp.static(s_step)
            d = wp.static(d_first) + c * wp.static(d_step)
            v_bar[s] += emission_bar[c] * v[d]
            v_bar[d] += emission_bar[c] * v[s]
            m_bar[k] += depth_bar[c] * ray.scale[c]
            ray_bar.scale[c] += depth_bar[c] * m[k]
        for b in range(wp.static(BEAMS)):
            for c in range(wp.static(C)):
                i = wp.static(C) + b * wp.static(C) + c
                k = c * wp.static(k_step)
                s = wp.static(s_first) + c * wp.static(s_step)
                j = wp.static(b_first) + b * wp.static(K) + k
                mass = m[k] + v[j]
                mass_bar = depth_bar[i] * ray.scale[c]
                ray_bar.scale[c] += depth_bar[i] * mass
                v_bar[s] += emission_bar[i] * phases[i]
                phase_bar = emission_bar[i] * v[s]
                if wp.static(HAS_PEAK) or wp.static(IS_POINT)[b] == 1:
                    way = F(0.0)
                    way_bar = F(0.0)
                    if wp.static(HAS_PEAK):
                        way = peak_of(v, ray.peak, c) * mass
                    if wp.static(IS_POINT)[b] == 1:
                        cosine = point_cosine(ray.foot[b], ray.across[b], t)
                        by_way, by_cosine, by_g = wp.grad(phase_slopes)(way, cosine, ray.g)
                        by_foot, by_across, by_t = wp.grad(cosine_slopes)(
                            ray.foot[b], ray.across[b], t
                        )
                        way_bar = phase_bar * by_way
                        ray_bar.foot[b] += phase_bar * by_cosine * by_foot
                        ray_bar.across[b] += phase_bar * by_cosine * by_across
                        t_bar += phase_bar * by_cosine * by_t
                        ray_bar.g += phase_bar * by_g
                    elif phases[i] > F(0.0):
                        place = place_of(way)
                        first = b * wp.static(COEFFICIENTS)
                        way_bar = phase_bar * polynomial_slope(
                            coefficients, first, ray.index, place
                        )
                        if coefficients_bar.shape[0] > 0:
                            add_polynomial_bar(coefficients_bar, first, ray.index, place, phase_bar)
                    if wp.static(HAS_PEAK):
                        mass_bar += way_bar * peak_of(v, ray.peak, c)
                        if wp.static(IS_PEAK_FIELD):
                            v_bar[wp.static(p_first) + c * wp.static(p_step)] += way_bar * mass
                        else:
                            ray_bar.peak[c] += way_bar * mass
                m_bar[k] += mass_bar
                v_bar[j] += mass_bar
        return v_bar, m_bar, t_bar, ray_bar

    @wp.func
    def emit_tangent(
        ray: Ray,
        v: Node,
        m: Mass,
        t: F,
        coefficients: wp.array2d(dtype=F),
        phases: Out,
        d_ray: Ray,
        d_v: Node,
        d_m: Mass,
        d_t: F,
        d_coefficients: wp.array2d(dtype=F),
    ):
        """The changes of emission and depth with those of all arguments."""
        d_emission, d_depth = Out(), Out()
        for c in range(wp.static(C)):
            k = c * wp.static(k_step)
            s = wp.static(s_first) + c * wp.static(s_step)
            d = wp.static(d_first) + c * wp.static(d_step)
            d_emission[c] = d_v[s] * v[d] + v[s] * d_v[d]
            d_depth[c] = d_ray.scale[c] * m[k] + ray.scale[c] * d_m[k]
        for b in range(wp.static(BEAMS)):
            for c in range(wp.static(C)):
                i = wp.static(C) + b * wp.static(C) + c
                k = c * wp.static(k_step)
                s = wp.static(s_first) + c * wp.static(s_step)
                j = wp.static(b_first) + b * wp.static(K) + k
                mass = m[k] + v[j]
                d_mass = d_m[k] + d_v[j]
                way = F(0.0)
                d_way = F(0.0)
                d_phase = F(0.0)
                if wp.static(HAS_PEAK):
                    way = peak_of(v, ray.peak, c) * mass
                    d_way = peak_of(d_v, d_ray.peak, c) * mass + peak_of(v, ray.peak, c) * d_mass
                if wp.static(IS_POINT)[b] == 1:
                    cosine = point_cosine(ray.foot[b], ray.across[b], t)
                    by_way, by_cosine, by_g = wp.grad(phase_slopes)(way, cosine, ray.g)
                    by_foot, by_across, by_t = wp.grad(cosine_slopes)(ray.foot[b], ray.across[b], t)
                    d_cosine = by_foot * d_ray.foot[b] + by_across * d_ray.across[b] + by_t * d_t
                    d_phase = by_way * d_way + by_cosine * d_cosine + by_g * d_ray.g
                elif wp.static(HAS_PEAK) and phases[i] > F(0.0):
                    place = place_of(way)
                    first = b * wp.static(COEFFICIENTS)
                    d_phase = polynomial_slope(
                        coefficients, first, ray.index, place
                    ) * d_way + polynomial(d_coefficients, first, ray.index, place)
                d_emission[i] = d_v[s] * phases[i] + v[s] * d_phase
                d_depth[i] = d_ray.scale[c] * mass + ray.scale[c] * d_mass
        return d_emission, d_depth

    return SimpleNamespace(emit=emit, emit_adjoint=emit_adjoint, emit_tangent=emit_tangent)
