"""Rays as fused kernels read them, and the few steps that all walks along them share.

The files of kernels have no postponed annotations: Warp reads the types of arguments.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused.layout import Layout


@functools.cache
def vectors(layout: Layout) -> SimpleNamespace:
    """The types of numbers, of a node's values and of what a ray adds up."""
    F: Any = wp.float64 if layout.bits == 64 else wp.float32

    def vector(length: int) -> Any:
        return wp.types.vector(length=max(length, 1), dtype=F)

    return SimpleNamespace(
        F=F,
        Node=vector(layout.channels),
        Mass=vector(layout.extinction),
        Color=vector(layout.colors),
        Out=vector(layout.outputs),
        PerBeam=vector(len(layout.beams)),
        Bent=vector(layout.masses),
        Triple=vector(3),
        Curve=vector(layout.terms),
        Weights=vector(4),
        Total=wp.types.vector(length=layout.extinction, dtype=wp.float64),
    )


@functools.cache
def ray_types(layout: Layout) -> SimpleNamespace:
    """The records `Bundle` (what a kernel is given), `Ray`, `Stop` at a node, and `Light`."""
    t = vectors(layout)

    @wp.struct
    class Bundle:
        """`rays` [R, 8]: origin and direction (in cells; across slices in u), near, far [u].

        `planes` [N]: nodes, across the slices [u] or as parts of the way from near to far; `cells`
        [n, h, w, channels]; `angles` [2 beams, R]: the cosine to directional light, or the foot of
        a point light, then its square distance; `coefficients` [beams * phases * COEFFICIENTS, R]:
        the polynomials of E13; `numbers`: scale and peak by color, bound of third-order
        corrections; `table` [phases * (steps + 1) * 2, terms]: those of point lights by angle;
        `fronts` [K, R]: the mass before the rays begin, of none where R is 0; `walked` [packets,
        words]: bits of the segments to be walked, of packets of so many `lanes`, or of none.
        """

        planes: wp.array(dtype=t.F)
        cells: wp.array4d(dtype=t.F)
        rays: wp.array2d(dtype=t.F)
        angles: wp.array2d(dtype=t.F)
        coefficients: wp.array2d(dtype=t.F)
        numbers: wp.array(dtype=t.F)
        table: wp.array2d(dtype=t.F)
        fronts: wp.array2d(dtype=t.F)
        walked: wp.array2d(dtype=int)
        lanes: int

    @wp.struct
    class Ray:
        """One of them; its cotangent and its tangent have the same fields."""

        index: int
        origin: t.Triple
        direction: t.Triple
        near: t.F
        far: t.F
        foot: t.PerBeam
        across: t.PerBeam
        scale: t.Color
        peak: t.Color
        bound: t.F

    @wp.struct
    class Stop:
        """A ray at a node; its cotangent and its tangent have the same fields.

        Distances: `s` that it is sampled at, `held` within the box. The place `q` in cells; values
        `v`, those of masses less corrections by `bent`. Of each output: emission `w`, depth `u`,
        `decay` exp(-u), and `p`.
        """

        s: t.F
        held: t.F
        q: t.Triple
        v: t.Node
        bent: t.Bent
        w: t.Out
        u: t.Out
        decay: t.Out
        p: t.Out

    @wp.struct
    class Light:
        """Light of beam `b` in color `c` at a node; its tangent has the same fields but these two.

        The `mass` on both ways, the `depth` of the peak on them, the `number` of the phase function
        there, the distance `held`, and p.
        """

        b: int
        c: int
        mass: t.F
        depth: t.F
        number: t.F
        held: t.F
        p: t.F

    return SimpleNamespace(Bundle=Bundle, Ray=Ray, Stop=Stop, Light=Light)


@functools.cache
def loading(layout: Layout) -> Any:
    """The function that reads a ray of `layout`."""
    records = ray_types(layout)

    @wp.func
    def load_ray(given: records.Bundle, r: int) -> records.Ray:
        ray = records.Ray()
        ray.index = r
        for axis in range(3):
            ray.origin[axis] = given.rays[r, axis]
            ray.direction[axis] = given.rays[r, 3 + axis]
        ray.near = given.rays[r, 6]
        ray.far = given.rays[r, 7]
        for b in range(wp.static(len(layout.beams))):
            ray.foot[b] = given.angles[b, r]
            ray.across[b] = given.angles[wp.static(len(layout.beams)) + b, r]
        for c in range(wp.static(layout.colors)):
            ray.scale[c] = given.numbers[c]
            ray.peak[c] = given.numbers[wp.static(layout.colors) + c]
        ray.bound = given.numbers[wp.static(2 * layout.colors)]
        return ray

    return load_ray


@functools.cache
def walking(layout: Layout) -> Any:
    """The function that says whether ray `r` stops at node n: at an end of a segment it walks."""
    Bundle = ray_types(layout).Bundle

    @wp.func
    def walks(given: Bundle, r: int, n: int) -> bool:
        if n < 0 or n >= given.planes.shape[0]:
            return False
        if given.walked.shape[0] == 0:
            return True
        packet, behind = r // given.lanes, n + 1
        is_end = (given.walked[packet, n // 32] >> (n % 32)) & 1
        if behind < given.planes.shape[0]:
            is_end |= (given.walked[packet, behind // 32] >> (behind % 32)) & 1
        return is_end != 0

    return walks


@functools.cache
def places(layout: Layout, is_sliced: bool) -> SimpleNamespace:
    """Where nodes of rays of `layout` are: in slices, or at equal steps."""
    t, Ray = vectors(layout), ray_types(layout).Ray

    @wp.func
    def place(ray: Ray, plane: t.F) -> t.F:
        """The distance at which a node is sampled [u]."""
        if wp.static(is_sliced):
            return (plane - ray.origin[0]) / ray.direction[0]
        return ray.near + plane * (ray.far - ray.near)

    @wp.func
    def hold(ray: Ray, distance: t.F) -> t.F:
        """The same held within the box: the distance of the node."""
        if wp.static(is_sliced):
            return wp.min(wp.max(distance, ray.near), ray.far)
        return distance

    return SimpleNamespace(place=place, hold=hold)


@functools.cache
def masses(layout: Layout) -> SimpleNamespace:
    """Masses along rays of `layout` (E1)."""
    t, Bundle = vectors(layout), ray_types(layout).Bundle

    @wp.func
    def front_of(given: Bundle, r: int) -> t.Mass:
        """The mass before ray `r` begins."""
        m = t.Mass()
        if given.fronts.shape[1] > 0:
            for k in range(wp.static(layout.extinction)):
                m[k] = given.fronts[k, r]
        return m

    @wp.func
    def widen(m: t.Mass) -> t.Total:
        """Masses in double precision."""
        total = t.Total()
        for k in range(wp.static(layout.extinction)):
            total[k] = wp.float64(m[k])
        return total

    @wp.func
    def add_mass(total: t.Total, v0: t.Node, v1: t.Node, length: t.F) -> t.Total:
        """The mass `total` with that of a segment, in which extinction is linear.

        Masses are added up in double precision: on the walk back they are subtracted again, and in
        front of an opaque volume little is left of much.
        """
        for k in range(wp.static(layout.extinction)):
            total[k] = total[k] + wp.float64(t.F(0.5) * (v0[k] + v1[k]) * length)
        return total

    @wp.func
    def mass_of(total: t.Total) -> t.Mass:
        """The same in the precision of all else."""
        m = t.Mass()
        for k in range(wp.static(layout.extinction)):
            m[k] = t.F(total[k])
        return m

    return SimpleNamespace(front_of=front_of, widen=widen, add_mass=add_mass, mass_of=mass_of)
