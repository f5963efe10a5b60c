"""The nodes of a ray, inside fused kernels: where they are, and the values there."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.rays import places, ray_types, vectors
from ddrecon.march.fused.sampling import sampling, slopes


@functools.cache
def stops(layout: Layout, is_sliced: bool) -> Any:
    """The function that stops at node n of a ray, but for what it emits there."""
    t, records = vectors(layout), ray_types(layout)
    at, cells = places(layout, is_sliced), sampling(layout, is_sliced)

    @wp.func
    def stop(given: records.Bundle, ray: records.Ray, n: int) -> records.Stop:
        here = records.Stop()
        here.s = at.place(ray, given.planes[n])
        here.held = at.hold(ray, here.s)
        here.q = ray.origin + here.s * ray.direction
        here.v = cells.sample(given.cells, n, here.q)
        if wp.static(layout.masses > 0):
            here.bent = cells.correct(given.cells, n, here.q)
        for k in range(wp.static(layout.masses)):
            x = here.bent[k]
            root = wp.sqrt(t.F(1.0) + ray.bound * ray.bound * x * x)
            of_mass = wp.static(layout.first_mass) + k
            here.v[of_mass] = here.v[of_mass] - x / root
        return here

    return stop


@functools.cache
def moving_places(layout: Layout, is_sliced: bool) -> SimpleNamespace:
    """The changes of `places`, with those of a ray."""
    t, Ray = vectors(layout), ray_types(layout).Ray

    @wp.func
    def change_distance(ray: Ray, d_ray: Ray, plane: t.F, s: t.F) -> t.F:
        """The change of `place`."""
        if wp.static(is_sliced):
            return -(d_ray.origin[0] + s * d_ray.direction[0]) / ray.direction[0]
        return d_ray.near + plane * (d_ray.far - d_ray.near)

    @wp.func
    def change_held(ray: Ray, d_ray: Ray, s: t.F, d_s: t.F) -> t.F:
        """The change of `hold`."""
        if wp.static(is_sliced):
            if s <= ray.near:
                return d_ray.near
            if s >= ray.far:
                return d_ray.far
        return d_s

    return SimpleNamespace(change_distance=change_distance, change_held=change_held)


@functools.cache
def moving_stops(layout: Layout, is_sliced: bool) -> Any:
    """The function that finds how a stop changes with the cells, and with its place in them."""
    t, records = vectors(layout), ray_types(layout)
    cells, slope = sampling(layout, is_sliced), slopes(layout, is_sliced)
    moving = moving_places(layout, is_sliced)

    @wp.func
    def change_stop(
        given: records.Bundle,
        d_given: records.Bundle,
        ray: records.Ray,
        d_ray: records.Ray,
        here: records.Stop,
        n: int,
    ) -> records.Stop:
        d_here = records.Stop()
        d_here.s = moving.change_distance(ray, d_ray, given.planes[n], here.s)
        d_here.held = moving.change_held(ray, d_ray, here.s, d_here.s)
        d_here.q = d_ray.origin + here.s * d_ray.direction + d_here.s * ray.direction
        d_here.v = cells.sample(d_given.cells, n, here.q)
        if wp.static(layout.masses > 0):
            d_here.bent = cells.correct(d_given.cells, n, here.q)
        for axis in range(wp.static(int(is_sliced)), 3):
            if d_here.q[axis] != t.F(0.0):
                d_here.v += d_here.q[axis] * slope.slope(given.cells, n, here.q, axis)
                if wp.static(layout.masses > 0):
                    by_place = slope.correct_slope(given.cells, n, here.q, axis)
                    d_here.bent += d_here.q[axis] * by_place
        # Of masses, the change of bounded corrections is taken off.
        for k in range(wp.static(layout.masses)):
            x = here.bent[k]
            inverse = t.F(1.0) / wp.sqrt(t.F(1.0) + ray.bound * ray.bound * x * x)
            change = d_here.bent[k] - d_ray.bound * ray.bound * x * x * x
            of_mass = wp.static(layout.first_mass) + k
            d_here.v[of_mass] = d_here.v[of_mass] - inverse * inverse * inverse * change
        return d_here

    return change_stop
