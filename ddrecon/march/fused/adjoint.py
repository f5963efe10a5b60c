"""The walk back along a ray, from behind the volume to the camera: the adjoint of its integral.

Nothing of the walk out was kept but the mass behind the ray: values are sampled anew, and masses
are those behind less those of the segments in between.
"""

import functools
from typing import Any

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.nodes import nodes
from ddrecon.march.fused.rays import ray_types, steps, vectors
from ddrecon.march.fused.sampling import sampling
from ddrecon.march.fused.segments import segments


@functools.cache
def adjoint_kernel(layout: Layout, is_sliced: bool, varies_rays: bool) -> Any:
    """The kernel that adds to `bars` what bars of outputs and masses are for all that is given.

    Each ray has its own `numbers` [2 C + 2, R] there. Bars of rays, angles and coefficients are
    found where it `varies_rays`; else their arrays may be empty.
    """
    types, records, step = vectors(layout), ray_types(layout), steps(layout, is_sliced)
    cells, node, segment = sampling(layout, is_sliced), nodes(layout), segments(layout)
    F: Any = types.F
    Node, Mass, Out, Bent, Triple = types.Node, types.Mass, types.Out, types.Bent, types.Triple
    Bundle, Ray = records.Bundle, records.Ray
    Total, load_ray, place, hold = types.Total, step.load_ray, step.place, step.hold
    add_mass, mass_of = step.add_mass, step.mass_of
    subtract_corrections, decays = step.subtract_corrections, step.decays
    sample, correct, spread = cells.sample, cells.correct, cells.spread
    slope, correct_slope = cells.slope, cells.correct_slope
    emit, emit_adjoint, arrive_adjoint = node.emit, node.emit_adjoint, segment.arrive_adjoint
    C, K, BEAMS, FIRST = layout.colors, layout.extinction, len(layout.beams), layout.first_mass
    MASSES, FIRST_AXIS = layout.masses, int(is_sliced)

    @wp.func
    def correction_bars(v_bar: Node, x: Bent, bound: F) -> Bent:
        """Bars of third-order corrections `x` from those of the values they are taken off."""
        out = Bent()
        for k in range(wp.static(MASSES)):
            inverse = F(1.0) / wp.sqrt(F(1.0) + bound * bound * x[k] * x[k])
            out[k] = -v_bar[wp.static(FIRST) + k] * inverse * inverse * inverse
        return out

    @wp.func
    def place_bars(
        ray: Ray,
        ray_bar: Ray,
        plane: F,
        n: int,
        q: Triple,
        s: F,
        t_bar: F,
        v_bar: Node,
        x_bar: Bent,
        values: wp.array4d(dtype=F),
    ) -> Ray:
        """`ray_bar` with what the place of node n adds, by its distance and by its values."""
        s_bar = t_bar
        if wp.static(is_sliced):
            # A node held at a face of the box moves with the face.
            if s <= ray.near:
                ray_bar.near += t_bar
                s_bar = F(0.0)
            elif s >= ray.far:
                ray_bar.far += t_bar
                s_bar = F(0.0)
        for axis in range(wp.static(FIRST_AXIS), 3):
            by_place = wp.dot(v_bar, slope(values, n, q, axis))
            if wp.static(MASSES > 0):
                by_place += wp.dot(x_bar, correct_slope(values, n, q, axis))
            ray_bar.origin[axis] += by_place
            ray_bar.direction[axis] += by_place * s
            s_bar += by_place * ray.direction[axis]
        if wp.static(is_sliced):
            ray_bar.origin[0] -= s_bar / ray.direction[0]
            ray_bar.direction[0] -= s_bar * s / ray.direction[0]
        else:
            ray_bar.near += s_bar * (F(1.0) - plane)
            ray_bar.far += s_bar * plane
        return ray_bar

    @wp.func
    def store(ray_bar: Ray, bars: Bundle, numbers_bar: wp.array2d(dtype=F)):
        r = ray_bar.index
        for c in range(wp.static(C)):
            numbers_bar[c, r] = ray_bar.scale[c]
            numbers_bar[wp.static(C) + c, r] = ray_bar.peak[c]
        numbers_bar[wp.static(2 * C), r] = ray_bar.g
        numbers_bar[wp.static(2 * C + 1), r] = ray_bar.bound
        if wp.static(varies_rays):
            for axis in range(3):
                bars.rays[r, axis] = ray_bar.origin[axis]
                bars.rays[r, 3 + axis] = ray_bar.direction[axis]
            bars.rays[r, 6] = ray_bar.near
            bars.rays[r, 7] = ray_bar.far
            for b in range(wp.static(BEAMS)):
                bars.angles[b, r] = ray_bar.foot[b]
                bars.angles[wp.static(BEAMS) + b, r] = ray_bar.across[b]

    @wp.kernel(enable_backward=False, module="unique")
    def transpose(
        first: int,
        given: Bundle,
        masses: wp.array2d(dtype=wp.float64),
        out_bar: wp.array2d(dtype=F),
        masses_bar: wp.array2d(dtype=F),
        bars: Bundle,
        numbers_bar: wp.array2d(dtype=F),
    ):
        r = first + wp.tid()
        ray = load_ray(given, r)
        ray_bar = Ray()
        ray_bar.index = r
        bar, m1, m_bar = Out(), Total(), Mass()
        for i in range(wp.static(layout.outputs)):
            bar[i] = out_bar[i, r]
        for k in range(wp.static(K)):
            m1[k] = masses[k, r]
            m_bar[k] = masses_bar[k, r]
        # Node 1 lies behind node 0. Its bars grow by the segments on both sides, then it is done.
        v1, c1, q1, s1, t1, t1_bar = Node(), Bent(), Triple(), F(0.0), F(0.0), F(0.0)
        w1, u1, x1, p1, w1_bar, u1_bar = Out(), Out(), Out(), Out(), Out(), Out()
        v1_bar = Node()
        count = given.planes.shape[0]
        for step in range(count + 1):
            n = count - 1 - step
            v0, c0, q0, s0, t0, t0_bar = Node(), Bent(), Triple(), F(0.0), F(0.0), F(0.0)
            w0, u0, x0, p0, w0_bar, u0_bar = Out(), Out(), Out(), Out(), Out(), Out()
            v0_bar = Node()
            m0 = m1
            if n >= 0:
                # Node 0, as on the walk out.
                s0 = place(ray, given.planes[n])
                q0 = ray.origin + s0 * ray.direction
                v0 = sample(given.cells, n, q0)
                if wp.static(MASSES > 0):
                    c0 = correct(given.cells, n, q0)
                    v0 = subtract_corrections(v0, c0, ray.bound)
                t0 = hold(ray, s0)
                if step > 0:
                    m0 = add_mass(m1, v0, v1, t0 - t1)
                w0, u0, p0 = emit(ray, v0, mass_of(m0), t0, given.coefficients)
                x0 = decays(u0)
            if step > 0:
                if n >= 0:
                    # The segment between both.
                    w_bar, u0_bar, u_bar, t0_bar, t_bar, ray_bar = arrive_adjoint(
                        ray, w0, w1, u0, u1, x0, x1, t0, t1, bar, ray_bar
                    )
                    w0_bar = w_bar
                    w1_bar += w_bar
                    u1_bar += u_bar
                    t1_bar += t_bar
                # What node 1 emits.
                e_v, e_m, e_t, ray_bar = emit_adjoint(
                    ray,
                    v1,
                    mass_of(m1),
                    t1,
                    given.coefficients,
                    p1,
                    w1_bar,
                    u1_bar,
                    ray_bar,
                    bars.coefficients,
                )
                v1_bar += e_v
                m_bar += e_m
                t1_bar += e_t
                # Its mass is that of node 0 and half the sum of extinctions, by the length.
                if n >= 0:
                    for k in range(wp.static(K)):
                        half = F(0.5) * m_bar[k]
                        v1_bar[k] += half * (t1 - t0)
                        v0_bar[k] += half * (t1 - t0)
                        t1_bar += half * (v0[k] + v1[k])
                        t0_bar -= half * (v0[k] + v1[k])
                # Its values go back to the cells, its place to the ray.
                c1_bar = correction_bars(v1_bar, c1, ray.bound)
                for k in range(wp.static(MASSES)):
                    ray_bar.bound -= c1_bar[k] * ray.bound * c1[k] * c1[k] * c1[k]
                spread(bars.cells, n + 1, q1, v1_bar, c1_bar)
                if wp.static(varies_rays):
                    ray_bar = place_bars(
                        ray,
                        ray_bar,
                        given.planes[n + 1],
                        n + 1,
                        q1,
                        s1,
                        t1_bar,
                        v1_bar,
                        c1_bar,
                        given.cells,
                    )
            v1 = v0
            c1 = c0
            q1 = q0
            s1 = s0
            t1 = t0
            w1 = w0
            u1 = u0
            x1 = x0
            p1 = p0
            m1 = m0
            v1_bar = v0_bar
            w1_bar = w0_bar
            u1_bar = u0_bar
            t1_bar = t0_bar
        store(ray_bar, bars, numbers_bar)

    return transpose
