"""The walk along a ray that finds its integral; and the walk that finds the change of it.

One thread walks one ray, from the camera into the volume. Nothing is kept but what is returned.
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
def integral_kernel(layout: Layout) -> Any:
    """The kernel of E1 to E3 along rays: outputs [outputs, R], and masses [K, R] of whole rays.

    In equal steps: rays that meet slices go in packets.
    """
    types, records, step = vectors(layout), ray_types(layout), steps(layout, is_sliced=False)
    cells = sampling(layout, is_sliced=False)
    F: Any = types.F
    Node, Total, Out, Bundle = types.Node, types.Total, types.Out, records.Bundle
    load_ray, place, hold = step.load_ray, step.place, step.hold
    add_mass, mass_of = step.add_mass, step.mass_of
    subtract_corrections, decays = step.subtract_corrections, step.decays
    sample, correct = cells.sample, cells.correct
    emit, arrive = nodes(layout).emit, segments(layout).arrive

    @wp.kernel(enable_backward=False, module="unique")
    def integrate(
        first: int,
        given: Bundle,
        out: wp.array2d(dtype=F),
        masses: wp.array2d(dtype=wp.float64),
    ):
        r = first + wp.tid()
        ray = load_ray(given, r)
        total, m, v0, t0 = Out(), Total(), Node(), F(0.0)
        w0, u0, x0 = Out(), Out(), Out()
        for n in range(given.planes.shape[0]):
            # The next node: its values, and its distance within the box.
            s = place(ray, given.planes[n])
            q = ray.origin + s * ray.direction
            v1 = sample(given.cells, n, q)
            if wp.static(layout.masses > 0):
                v1 = subtract_corrections(v1, correct(given.cells, n, q), ray.bound)
            t1 = hold(ray, s)
            # The mass passed on the way to it, and what it emits behind that.
            if n > 0:
                m = add_mass(m, v0, v1, t1 - t0)
            w1, u1, _ = emit(ray, v1, mass_of(m), t1, given.coefficients)
            x1 = decays(u1)
            # E2, E3: what arrives from the segment between both.
            if n > 0:
                total += arrive(ray, w0, w1, u0, u1, x0, x1, t0, t1)
            v0 = v1
            w0 = w1
            u0 = u1
            x0 = x1
            t0 = t1
        for i in range(wp.static(layout.outputs)):
            out[i, r] = total[i]
        for k in range(wp.static(layout.extinction)):
            masses[k, r] = m[k]

    return integrate


@functools.cache
def tangent_kernel(layout: Layout, is_sliced: bool) -> Any:
    """The kernel of the changes of outputs and masses with those of all that is given."""
    types, records, step = vectors(layout), ray_types(layout), steps(layout, is_sliced)
    cells, node, segment = sampling(layout, is_sliced), nodes(layout), segments(layout)
    F: Any = types.F
    Node, Mass, Total = types.Node, types.Mass, types.Total
    Out, Bent = types.Out, types.Bent
    Bundle, Ray = records.Bundle, records.Ray
    load_ray, place, hold = step.load_ray, step.place, step.hold
    add_mass, mass_of = step.add_mass, step.mass_of
    subtract_corrections, decays = step.subtract_corrections, step.decays
    sample, correct, slope, correct_slope = (
        cells.sample,
        cells.correct,
        cells.slope,
        cells.correct_slope,
    )
    emit, emit_tangent, arrive_tangent = node.emit, node.emit_tangent, segment.arrive_tangent
    FIRST, FIRST_AXIS = layout.first_mass, int(is_sliced)

    @wp.func
    def change_distance(ray: Ray, d_ray: Ray, plane: F, s: F) -> F:
        """The change of `place`."""
        if wp.static(is_sliced):
            return -(d_ray.origin[0] + s * d_ray.direction[0]) / ray.direction[0]
        return d_ray.near + plane * (d_ray.far - d_ray.near)

    @wp.func
    def change_held(ray: Ray, d_ray: Ray, s: F, d_s: F) -> F:
        """The change of `hold`."""
        if wp.static(is_sliced):
            if s <= ray.near:
                return d_ray.near
            if s >= ray.far:
                return d_ray.far
        return d_s

    @wp.func
    def change_values(v: Node, x: Bent, d_x: Bent, bound: F, d_bound: F) -> Node:
        """The change `v` of linear values, with that of masses' bounded corrections taken off."""
        for k in range(wp.static(layout.masses)):
            inverse = F(1.0) / wp.sqrt(F(1.0) + bound * bound * x[k] * x[k])
            change = d_x[k] - d_bound * bound * x[k] * x[k] * x[k]
            v[wp.static(FIRST) + k] = v[wp.static(FIRST) + k] - inverse * inverse * inverse * change
        return v

    @wp.kernel(enable_backward=False, module="unique")
    def change(
        first: int,
        given: Bundle,
        d_given: Bundle,
        d_out: wp.array2d(dtype=F),
        d_masses: wp.array2d(dtype=F),
    ):
        r = first + wp.tid()
        ray = load_ray(given, r)
        d_ray = load_ray(d_given, r)
        total, whole, v0, t0 = Out(), Total(), Node(), F(0.0)
        w0, u0, x0 = Out(), Out(), Out()
        d_m, d_v0, d_t0, d_w0, d_u0 = Mass(), Node(), F(0.0), Out(), Out()
        for n in range(given.planes.shape[0]):
            # Values of the next node change with the cells, and with its place in them.
            s = place(ray, given.planes[n])
            d_s = change_distance(ray, d_ray, given.planes[n], s)
            q = ray.origin + s * ray.direction
            d_q = d_ray.origin + s * d_ray.direction + d_s * ray.direction
            v1 = sample(given.cells, n, q)
            d_v1 = sample(d_given.cells, n, q)
            for axis in range(wp.static(FIRST_AXIS), 3):
                if d_q[axis] != F(0.0):
                    d_v1 += d_q[axis] * slope(given.cells, n, q, axis)
            if wp.static(layout.masses > 0):
                x = correct(given.cells, n, q)
                d_x = correct(d_given.cells, n, q)
                for axis in range(wp.static(FIRST_AXIS), 3):
                    if d_q[axis] != F(0.0):
                        d_x += d_q[axis] * correct_slope(given.cells, n, q, axis)
                v1 = subtract_corrections(v1, x, ray.bound)
                d_v1 = change_values(d_v1, x, d_x, ray.bound, d_ray.bound)
            t1 = hold(ray, s)
            d_t1 = change_held(ray, d_ray, s, d_s)
            # The mass on the way to it: half the sum of both, by the length.
            if n > 0:
                for k in range(wp.static(layout.extinction)):
                    longer = (v0[k] + v1[k]) * (d_t1 - d_t0)
                    d_m[k] = d_m[k] + F(0.5) * ((d_v0[k] + d_v1[k]) * (t1 - t0) + longer)
                whole = add_mass(whole, v0, v1, t1 - t0)
            m = mass_of(whole)
            w1, u1, p1 = emit(ray, v1, m, t1, given.coefficients)
            d_w1, d_u1 = emit_tangent(
                ray, v1, m, t1, given.coefficients, p1, d_ray, d_v1, d_m, d_t1, d_given.coefficients
            )
            x1 = decays(u1)
            if n > 0:
                total += arrive_tangent(
                    ray, w0, w1, u0, u1, x0, x1, t0, t1, d_ray, d_w0, d_w1, d_u0, d_u1, d_t0, d_t1
                )
            v0 = v1
            w0 = w1
            u0 = u1
            x0 = x1
            t0 = t1
            d_v0 = d_v1
            d_w0 = d_w1
            d_u0 = d_u1
            d_t0 = d_t1
        for i in range(wp.static(layout.outputs)):
            d_out[i, r] = total[i]
        for k in range(wp.static(layout.extinction)):
            d_masses[k, r] = d_m[k]

    return change
