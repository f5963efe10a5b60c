"""What a node of a ray emits towards the camera and through how much, and both derivatives of that.

The outputs of a ray are numbered: C colors of diffuse light (E3), then C of each beam (E2). For
each of them a node has an emission w (kappa_s times radiance or p, per unit of scale) and a depth u
(to the camera, for beams to the light as well); light that arrives is the integral of emission
times exp(-depth).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from ddrecon.march.fused.layout import Layout
from ddrecon.march.fused.node_phases import node_phase, node_phase_adjoint, node_phase_tangent
from ddrecon.march.fused.rays import ray_types, vectors


@functools.cache
def _channels(layout: Layout) -> SimpleNamespace:
    """Channels of color c in a node: kappa_s, of beams and of diffuse light, and that light itself.

    And the mass from here to beam b.
    """

    @wp.func
    def diffusing(c: int) -> int:
        return wp.static(layout.diffusing_from) + c * wp.static(layout.diffusing_step)

    @wp.func
    def scattering(c: int) -> int:
        return wp.static(layout.scattering_from) + c * wp.static(layout.scattering_step)

    @wp.func
    def diffuse(c: int) -> int:
        return wp.static(layout.extinction) + c * wp.static(layout.diffuse_step)

    @wp.func
    def to_light(b: int, k: int) -> int:
        return wp.static(layout.first_mass) + b * wp.static(layout.extinction) + k

    return SimpleNamespace(
        diffusing=diffusing, scattering=scattering, diffuse=diffuse, to_light=to_light
    )


@functools.cache
def emission(layout: Layout) -> Any:
    """The function that adds to a stop behind the mass `m` what it emits, through how much."""
    t, records = vectors(layout), ray_types(layout)
    at, at_node = _channels(layout), node_phase(layout)
    C, BEAMS = layout.colors, len(layout.beams)

    @wp.func
    def emit(
        ray: records.Ray, here: records.Stop, m: t.Mass, given: records.Bundle
    ) -> records.Stop:
        for c in range(wp.static(C)):
            here.w[c] = here.v[at.diffusing(c)] * here.v[at.diffuse(c)]
            here.u[c] = ray.scale[c] * m[c * wp.static(layout.mass_step)]
        for b in range(wp.static(BEAMS)):
            for c in range(wp.static(C)):
                i = wp.static(C) + b * wp.static(C) + c
                k = c * wp.static(layout.mass_step)
                mass = m[k] + here.v[at.to_light(b, k)]
                p = at_node.phase(ray, at_node.light_of(ray, here.v, here.held, mass, b, c), given)
                here.p[i] = p
                here.w[i] = here.v[at.scattering(c)] * p
                here.u[i] = ray.scale[c] * mass
        for i in range(wp.static(layout.outputs)):
            here.decay[i] = wp.exp(-here.u[i])
        return here

    return emit


@functools.cache
def emission_adjoint(layout: Layout) -> Any:
    """The function that adds to bars of ray, stop and mass `m` what those of emission are."""
    t, records, at = vectors(layout), ray_types(layout), _channels(layout)
    Ray, Stop, beam_adjoint = records.Ray, records.Stop, _beam_adjoint(layout)
    at_node, Bundle = node_phase(layout), records.Bundle

    @wp.func
    def emit_adjoint(
        ray: Ray,
        here: Stop,
        m: t.Mass,
        given: Bundle,
        ray_bar: Ray,
        here_bar: Stop,
        m_bar: t.Mass,
        bars: Bundle,
    ):
        # Summed up by themselves first.
        found, found_m = Stop(), t.Mass()
        found.w = here_bar.w
        found.u = here_bar.u
        for c in range(wp.static(layout.colors)):
            k = c * wp.static(layout.mass_step)
            found.v[at.diffusing(c)] += here_bar.w[c] * here.v[at.diffuse(c)]
            found.v[at.diffuse(c)] += here_bar.w[c] * here.v[at.diffusing(c)]
            found_m[k] += here_bar.u[c] * ray.scale[c]
            ray_bar.scale[c] += here_bar.u[c] * m[k]
        for b in range(wp.static(len(layout.beams))):
            for c in range(wp.static(layout.colors)):
                k = c * wp.static(layout.mass_step)
                mass = m[k] + here.v[at.to_light(b, k)]
                light = at_node.light_of(ray, here.v, here.held, mass, b, c)
                light.p = here.p[(b + 1) * wp.static(layout.colors) + c]
                ray_bar, found, found_m = beam_adjoint(
                    ray, here, light, given, ray_bar, found, found_m, bars
                )
        here_bar.v += found.v
        here_bar.held += found.held
        return ray_bar, here_bar, m_bar + found_m

    return emit_adjoint


@functools.cache
def _beam_adjoint(layout: Layout) -> Any:
    """The function that adds what the bars of beam b's emission and depth in color c are."""
    t, records, at = vectors(layout), ray_types(layout), _channels(layout)
    Ray, Stop, Bundle, Light = records.Ray, records.Stop, records.Bundle, records.Light
    at_node, phase_adjoint = node_phase(layout), node_phase_adjoint(layout)

    @wp.func
    def beam_adjoint(
        ray: Ray,
        here: Stop,
        light: Light,
        given: Bundle,
        ray_bar: Ray,
        here_bar: Stop,
        m_bar: t.Mass,
        bars: Bundle,
    ):
        b, c = light.b, light.c
        i = (b + 1) * wp.static(layout.colors) + c
        k = c * wp.static(layout.mass_step)
        s = at.scattering(c)
        # u = scale mass
        mass_bar = here_bar.u[i] * ray.scale[c]
        ray_bar.scale[c] += here_bar.u[i] * light.mass
        # w = kappa_s p
        here_bar.v[s] += here_bar.w[i] * light.p
        p_bar = here_bar.w[i] * here.v[s]
        # p of E13 by depth = kappa_peak mass
        depth_bar, number_bar, held_bar, ray_bar = phase_adjoint(
            ray, light, given, p_bar, ray_bar, bars
        )
        here_bar.held += held_bar
        if wp.static(layout.form is not None):
            of_number = wp.static(layout.first_number) + c * wp.static(layout.number_step)
            here_bar.v[of_number] += number_bar
        if wp.static(layout.peak is not None):
            mass_bar += depth_bar * at_node.peak_of(here.v, ray.peak, c)
            if wp.static(bool(layout.peak)):
                peak = wp.static(layout.first_peak) + c * wp.static(layout.peak_step)
                here_bar.v[peak] += depth_bar * light.mass
            else:
                ray_bar.peak[c] += depth_bar * light.mass
        m_bar[k] += mass_bar
        here_bar.v[at.to_light(b, k)] += mass_bar
        return ray_bar, here_bar, m_bar

    return beam_adjoint


@functools.cache
def emission_tangent(layout: Layout) -> Any:
    """The function that adds to the change of a stop those of its emission and depth."""
    t, records, at = vectors(layout), ray_types(layout), _channels(layout)
    Ray, Stop, beam_tangent = records.Ray, records.Stop, _beam_tangent(layout)
    at_node, Bundle = node_phase(layout), records.Bundle

    @wp.func
    def emit_tangent(
        ray: Ray,
        here: Stop,
        m: t.Mass,
        given: Bundle,
        d_ray: Ray,
        d_here: Stop,
        d_m: t.Mass,
        d_given: Bundle,
    ) -> Stop:
        for c in range(wp.static(layout.colors)):
            k = c * wp.static(layout.mass_step)
            s = at.diffusing(c)
            d = at.diffuse(c)
            d_here.w[c] = d_here.v[s] * here.v[d] + here.v[s] * d_here.v[d]
            d_here.u[c] = d_ray.scale[c] * m[k] + ray.scale[c] * d_m[k]
        for b in range(wp.static(len(layout.beams))):
            for c in range(wp.static(layout.colors)):
                k = c * wp.static(layout.mass_step)
                mass = m[k] + here.v[at.to_light(b, k)]
                d_mass = d_m[k] + d_here.v[at.to_light(b, k)]
                light = at_node.light_of(ray, here.v, here.held, mass, b, c)
                light.p = here.p[(b + 1) * wp.static(layout.colors) + c]
                d_light = at_node.change_light(
                    ray, here.v, light, d_ray, d_here.v, d_here.held, d_mass
                )
                d_here = beam_tangent(ray, here, light, given, d_ray, d_here, d_light, d_given)
        return d_here

    return emit_tangent


@functools.cache
def _beam_tangent(layout: Layout) -> Any:
    """The function of the changes of beam b's emission and depth in color c."""
    records, at = ray_types(layout), _channels(layout)
    Ray, Stop, Bundle, Light = records.Ray, records.Stop, records.Bundle, records.Light
    phase_tangent = node_phase_tangent(layout)

    @wp.func
    def beam_tangent(
        ray: Ray,
        here: Stop,
        light: Light,
        given: Bundle,
        d_ray: Ray,
        d_here: Stop,
        d_light: Light,
        d_given: Bundle,
    ) -> Stop:
        c = light.c
        i = (light.b + 1) * wp.static(layout.colors) + c
        s = at.scattering(c)
        d_p = phase_tangent(ray, light, given, d_ray, d_light, d_given)
        d_here.w[i] = d_here.v[s] * light.p + here.v[s] * d_p
        d_here.u[i] = d_ray.scale[c] * light.mass + ray.scale[c] * d_light.mass
        return d_here

    return beam_tangent
