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
        Total=wp.types.vector(length=layout.extinction, dtype=wp.float64),
    )


@functools.cache
def ray_types(layout: Layout) -> SimpleNamespace:
    """The records `Bundle` (what a kernel is given), `Ray` and `Change`."""
    types = vectors(layout)
    F, Color, PerBeam, Triple = types.F, types.Color, types.PerBeam, types.Triple

    @wp.struct
    class Bundle:
        """`rays` [R, 8]: origin and direction (in cells; across slices in u), near, far [u].

        `planes` [N]: nodes, across the slices [u] or as parts of the way from near to far; `cells`
        [n, h, w, channels]; `angles` [2 beams, R]: the cosine to directional light, or the foot of
        a point light, then its square distance; `coefficients` [10 beams, R]: the polynomial of
        E13; `numbers`: scale and peak by color, g, bound of third-order corrections.
        """

        planes: wp.array(dtype=F)
        cells: wp.array4d(dtype=F)
        rays: wp.array2d(dtype=F)
        angles: wp.array2d(dtype=F)
        coefficients: wp.array2d(dtype=F)
        numbers: wp.array(dtype=F)

    @wp.struct
    class Ray:
        """One of them; its cotangent and its tangent have the same fields."""

        index: int
        origin: Triple
        direction: Triple
        near: F
        far: F
        foot: PerBeam
        across: PerBeam
        scale: Color
        peak: Color
        g: F
        bound: F

    return SimpleNamespace(Bundle=Bundle, Ray=Ray)


@functools.cache
def steps(layout: Layout, is_sliced: bool) -> SimpleNamespace:
    """The functions below for rays of `layout`, whose nodes lie in slices or at equal steps."""
    types, records = vectors(layout), ray_types(layout)
    F, Node, Mass, Out, Bent = types.F, types.Node, types.Mass, types.Out, types.Bent
    Total = types.Total
    Bundle, Ray = records.Bundle, records.Ray
    C, K, BEAMS, FIRST, MASSES = (
        layout.colors,
        layout.extinction,
        len(layout.beams),
        layout.first_mass,
        layout.masses,
    )

    @wp.func
    def load_ray(given: Bundle, r: int) -> Ray:
        ray = Ray()
        ray.index = r
        for axis in range(3):
            ray.origin[axis] = given.rays[r, axis]
            ray.direction[axis] = given.rays[r, 3 + axis]
        ray.near = given.rays[r, 6]
        ray.far = given.rays[r, 7]
        for b in range(wp.static(BEAMS)):
            ray.foot[b] = given.angles[b, r]
            ray.across[b] = given.angles[wp.static(BEAMS) + b, r]
        for c in range(wp.static(C)):
            ray.scale[c] = given.numbers[c]
            ray.peak[c] = given.numbers[wp.static(C) + c]
        ray.g = given.numbers[wp.static(2 * C)]
        ray.bound = given.numbers[wp.static(2 * C + 1)]
        return ray

    @wp.func
    def place(ray: Ray, plane: F) -> F:
        """The distance at which a node is sampled [u]."""
        if wp.static(is_sliced):
            return (plane - ray.origin[0]) / ray.direction[0]
        return ray.near + plane * (ray.far - ray.near)

    @wp.func
    def hold(ray: Ray, distance: F) -> F:
        """The same held within the box: the distance of the node."""
        if wp.static(is_sliced):
            return wp.min(wp.max(distance, ray.near), ray.far)
        return distance

    @wp.func
    def subtract_corrections(v: Node, x: Bent, bound: F) -> Node:
        """Values `v` with masses to third order: less x / sqrt(1 + (bound x)^2)."""
        for k in range(wp.static(MASSES)):
            root = wp.sqrt(F(1.0) + bound * bound * x[k] * x[k])
            v[wp.static(FIRST) + k] = v[wp.static(FIRST) + k] - x[k] / root
        return v

    @wp.func
    def add_mass(total: Total, v0: Node, v1: Node, length: F) -> Total:
        """The mass `total` with that of a segment, in which extinction is linear.

        Masses are added up in double precision: on the walk back they are subtracted again, and in
        front of an opaque volume little is left of much.
        """
        for k in range(wp.static(K)):
            total[k] = total[k] + wp.float64(F(0.5) * (v0[k] + v1[k]) * length)
        return total

    @wp.func
    def mass_of(total: Total) -> Mass:
        """The same in the precision of all else."""
        m = Mass()
        for k in range(wp.static(K)):
            m[k] = F(total[k])
        return m

    @wp.func
    def decays(depth: Out) -> Out:
        """exp(-depth) of each output."""
        out = Out()
        for i in range(wp.static(layout.outputs)):
            out[i] = wp.exp(-depth[i])
        return out

    return SimpleNamespace(
        load_ray=load_ray,
        place=place,
        hold=hold,
        subtract_corrections=subtract_corrections,
        add_mass=add_mass,
        mass_of=mass_of,
        decays=decays,
    )
