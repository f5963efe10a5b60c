"""The walk back along a ray, from behind the volume to the camera: the adjoint of its integral.

Nothing of the walk out was kept but the mass behind the ray: values are sampled anew, and masses
are those behind less those of the segments in between.
"""

import functools
from typing import Any

import warp as wp

from ddrecon.march.fused.emission import emission, emission_adjoint
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.rays import loading, masses, ray_types, vectors, walking
from ddrecon.march.fused.sampling import sampling, slopes
from ddrecon.march.fused.segments import arrival_adjoint
from ddrecon.march.fused.stops import stops


@functools.cache
def adjoint_kernel(layout: Layout, is_sliced: bool, varies_rays: bool) -> Any:
    """The kernel that adds to `bars` what bars of outputs and masses are for all that is given.

    Each ray has its own `numbers` [2 C + 1, R] there. Bars of rays, angles and coefficients are
    found where it `varies_rays`; else their arrays may be empty.
    """
    t, records, passed = vectors(layout), ray_types(layout), masses(layout)
    load_ray, stop, emit = loading(layout), stops(layout, is_sliced), emission(layout)
    arrive_adjoint, emit_adjoint = arrival_adjoint(layout), emission_adjoint(layout)
    mass_adjoint, store = _mass_adjoint(layout), _storing(layout, varies_rays)
    leave, walks = _leaving(layout, is_sliced, varies_rays), walking(layout)

    @wp.kernel(enable_backward=False, module="unique")
    def transpose(
        first: int,
        given: records.Bundle,
        masses: wp.array2d(dtype=wp.float64),
        out_bar: wp.array2d(dtype=t.F),
        masses_bar: wp.array2d(dtype=t.F),
        bars: records.Bundle,
        numbers_bar: wp.array2d(dtype=t.F),
    ):
        r = first + wp.tid()
        ray = load_ray(given, r)
        ray_bar, bar, behind, m_bar = records.Ray(), t.Out(), t.Total(), t.Mass()
        ray_bar.index = r
        for i in range(wp.static(layout.outputs)):
            bar[i] = out_bar[i, r]
        for k in range(wp.static(layout.extinction)):
            behind[k] = masses[k, r]
            m_bar[k] = masses_bar[k, r]
        # Node b lies behind node a. Its bars grow by the segments on both sides, then it is done.
        b, b_bar = records.Stop(), records.Stop()
        count = given.planes.shape[0]
        for step in range(count + 1):
            n = count - 1 - step
            has_a, has_b = walks(given, r, n), walks(given, r, n + 1)
            a, a_bar = records.Stop(), records.Stop()
            m = behind
            if has_a:
                # As on the walk out.
                a = stop(given, ray, n)
                if has_b:
                    m = passed.add_mass(behind, a.v, b.v, a.held - b.held)
                a = emit(ray, a, passed.mass_of(m), given)
            if has_b:
                if has_a:
                    ray_bar, a_bar, b_bar = arrive_adjoint(ray, a, b, bar, ray_bar, a_bar, b_bar)
                mass = passed.mass_of(behind)
                ray_bar, b_bar, m_bar = emit_adjoint(
                    ray, b, mass, given, ray_bar, b_bar, m_bar, bars
                )
                if has_a:
                    a_bar, b_bar = mass_adjoint(a, b, m_bar, a_bar, b_bar)
                ray_bar = leave(given, ray, b, n + 1, ray_bar, b_bar, bars)
            b = a
            b_bar = a_bar
            behind = m
        if bars.fronts.shape[1] > 0:
            for k in range(wp.static(layout.extinction)):
                bars.fronts[k, r] = m_bar[k]
        store(ray_bar, bars, numbers_bar)

    return transpose


@functools.cache
def _mass_adjoint(layout: Layout) -> Any:
    """E1: the mass at node b is that at node a and half the sum of extinctions, by the length."""
    t, Stop = vectors(layout), ray_types(layout).Stop

    @wp.func
    def mass_adjoint(a: Stop, b: Stop, m_bar: t.Mass, a_bar: Stop, b_bar: Stop):
        for k in range(wp.static(layout.extinction)):
            half = t.F(0.5) * m_bar[k]
            b_bar.v[k] += half * (b.held - a.held)
            a_bar.v[k] += half * (b.held - a.held)
            b_bar.held += half * (a.v[k] + b.v[k])
            a_bar.held -= half * (a.v[k] + b.v[k])
        return a_bar, b_bar

    return mass_adjoint


@functools.cache
def _leaving(layout: Layout, is_sliced: bool, varies_rays: bool) -> Any:
    """The function that hands the bars of node n to the cells, and to the ray by its place."""
    t, records, cells = vectors(layout), ray_types(layout), sampling(layout, is_sliced)
    Ray, Stop, move = records.Ray, records.Stop, _moving(layout, is_sliced)

    @wp.func
    def leave(
        given: records.Bundle,
        ray: Ray,
        here: Stop,
        n: int,
        ray_bar: Ray,
        bar: Stop,
        bars: records.Bundle,
    ) -> Ray:
        # Corrections x of masses are taken off as x / sqrt(1 + (bound x)^2).
        for k in range(wp.static(layout.masses)):
            x = here.bent[k]
            inverse = t.F(1.0) / wp.sqrt(t.F(1.0) + ray.bound * ray.bound * x * x)
            x_bar = -bar.v[wp.static(layout.first_mass) + k] * inverse * inverse * inverse
            bar.bent[k] = x_bar
            ray_bar.bound -= x_bar * ray.bound * x * x * x
        cells.spread(bars.cells, n, here.q, bar.v, bar.bent)
        if wp.static(varies_rays):
            ray_bar = move(given, ray, here, n, ray_bar, bar)
        return ray_bar

    return leave


@functools.cache
def _moving(layout: Layout, is_sliced: bool) -> Any:
    """The function that adds to the ray's bars what the place of node n adds."""
    t, records, cells = vectors(layout), ray_types(layout), slopes(layout, is_sliced)
    Ray, Stop = records.Ray, records.Stop

    @wp.func
    def move(given: records.Bundle, ray: Ray, here: Stop, n: int, ray_bar: Ray, bar: Stop) -> Ray:
        s_bar = bar.held
        if wp.static(is_sliced):
            # A node held at a face of the box moves with the face.
            if here.s <= ray.near:
                ray_bar.near += bar.held
                s_bar = t.F(0.0)
            elif here.s >= ray.far:
                ray_bar.far += bar.held
                s_bar = t.F(0.0)
        for axis in range(wp.static(int(is_sliced)), 3):
            by_place = wp.dot(bar.v, cells.slope(given.cells, n, here.q, axis))
            if wp.static(layout.masses > 0):
                by_place += wp.dot(bar.bent, cells.correct_slope(given.cells, n, here.q, axis))
            ray_bar.origin[axis] += by_place
            ray_bar.direction[axis] += by_place * here.s
            s_bar += by_place * ray.direction[axis]
        if wp.static(is_sliced):
            ray_bar.origin[0] -= s_bar / ray.direction[0]
            ray_bar.direction[0] -= s_bar * here.s / ray.direction[0]
        else:
            ray_bar.near += s_bar * (t.F(1.0) - given.planes[n])
            ray_bar.far += s_bar * given.planes[n]
        return ray_bar

    return move


@functools.cache
def _storing(layout: Layout, varies_rays: bool) -> Any:
    """The function that writes the bars of a ray."""
    t, records, BEAMS = vectors(layout), ray_types(layout), len(layout.beams)

    @wp.func
    def store(ray_bar: records.Ray, bars: records.Bundle, numbers_bar: wp.array2d(dtype=t.F)):
        r = ray_bar.index
        for c in range(wp.static(layout.colors)):
            numbers_bar[c, r] = ray_bar.scale[c]
            numbers_bar[wp.static(layout.colors) + c, r] = ray_bar.peak[c]
        numbers_bar[wp.static(2 * layout.colors), r] = ray_bar.bound
        if wp.static(varies_rays):
            for axis in range(3):
                bars.rays[r, axis] = ray_bar.origin[axis]
                bars.rays[r, 3 + axis] = ray_bar.direction[axis]
            bars.rays[r, 6] = ray_bar.near
            bars.rays[r, 7] = ray_bar.far
            for b in range(wp.static(BEAMS)):
                bars.angles[b, r] = ray_bar.foot[b]
                bars.angles[wp.static(BEAMS) + b, r] = ray_bar.across[b]

    return store
