"""The walk along a ray that finds its integral; and the walk that finds the change of it.

One thread walks one ray, from the camera into the volume. Nothing is kept but what is returned.
"""

import functools
from typing import Any

import warp as wp

from ddrecon.march.fused.emission import emission, emission_tangent
from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.rays import loading, masses, ray_types, vectors, walking
from ddrecon.march.fused.segments import arrival, arrival_tangent
from ddrecon.march.fused.stops import moving_stops, stops


@functools.cache
def integral_kernel(layout: Layout) -> Any:
    """The kernel of E1 to E3 along rays: outputs [outputs, R], and masses [K, R] of whole rays.

    In equal steps: rays that meet slices go in packets.
    """
    t, records, passed = vectors(layout), ray_types(layout), masses(layout)
    load_ray, stop = loading(layout), stops(layout, is_sliced=False)
    emit, arrive = emission(layout), arrival(layout)

    @wp.kernel(enable_backward=False, module="unique")
    def integrate(
        first: int,
        given: records.Bundle,
        out: wp.array2d(dtype=t.F),
        masses: wp.array2d(dtype=wp.float64),
    ):
        r = first + wp.tid()
        ray = load_ray(given, r)
        total, before = t.Out(), records.Stop()
        m = passed.widen(passed.front_of(given, r))
        for n in range(given.planes.shape[0]):
            here = stop(given, ray, n)
            # The mass passed on the way to it, and what it emits behind that.
            if n > 0:
                m = passed.add_mass(m, before.v, here.v, here.held - before.held)
            here = emit(ray, here, passed.mass_of(m), given)
            # E2, E3: what arrives from the segment between both.
            if n > 0:
                total += arrive(ray, before, here)
            before = here
        for i in range(wp.static(layout.outputs)):
            out[i, r] = total[i]
        for k in range(wp.static(layout.extinction)):
            masses[k, r] = m[k]

    return integrate


@functools.cache
def tangent_kernel(layout: Layout, is_sliced: bool) -> Any:
    """The kernel of the changes of outputs and masses with those of all that is given."""
    t, records, passed = vectors(layout), ray_types(layout), masses(layout)
    load_ray, stop = loading(layout), stops(layout, is_sliced)
    emit, change_stop = emission(layout), moving_stops(layout, is_sliced)
    emit_tangent, arrive_tangent = emission_tangent(layout), arrival_tangent(layout)
    walks = walking(layout)

    @wp.kernel(enable_backward=False, module="unique")
    def change(
        first: int,
        given: records.Bundle,
        d_given: records.Bundle,
        d_out: wp.array2d(dtype=t.F),
        d_masses: wp.array2d(dtype=t.F),
    ):
        r = first + wp.tid()
        ray = load_ray(given, r)
        d_ray = load_ray(d_given, r)
        total, before, d_before = t.Out(), records.Stop(), records.Stop()
        m, d_m = passed.widen(passed.front_of(given, r)), passed.front_of(d_given, r)
        for n in range(given.planes.shape[0]):
            if walks(given, r, n):
                is_behind = walks(given, r, n - 1)
                here = stop(given, ray, n)
                d_here = change_stop(given, d_given, ray, d_ray, here, n)
                # The mass on the way to it: half the sum of both, by the length.
                if is_behind:
                    for k in range(wp.static(layout.extinction)):
                        longer = (before.v[k] + here.v[k]) * (d_here.held - d_before.held)
                        denser = (d_before.v[k] + d_here.v[k]) * (here.held - before.held)
                        d_m[k] = d_m[k] + t.F(0.5) * (denser + longer)
                    m = passed.add_mass(m, before.v, here.v, here.held - before.held)
                mass = passed.mass_of(m)
                here = emit(ray, here, mass, given)
                d_here = emit_tangent(ray, here, mass, given, d_ray, d_here, d_m, d_given)
                if is_behind:
                    total += arrive_tangent(ray, before, here, d_ray, d_before, d_here)
                before = here
                d_before = d_here
        for i in range(wp.static(layout.outputs)):
            d_out[i, r] = total[i]
        for k in range(wp.static(layout.extinction)):
            d_masses[k, r] = d_m[k]

    return change
